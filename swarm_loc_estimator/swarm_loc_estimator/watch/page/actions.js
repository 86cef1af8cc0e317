// What a viewer may do to the swarm: reset, set a pose by dragging, drive by keyboard. Each is confirmed first.
const DRIVE_MS = 100;
const KEYS = { ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowLeft: [0, 1], ArrowRight: [0, -1], w: [1, 0], s: [-1, 0], a: [0, 1], d: [0, -1] };

class Actions {
  constructor(app) {
    this.app = app;
    this.placed = null; // x, y, theta that a pose is about to be set to
    this.driven = -1;
    this.keys = new Set();
    element("reset").onclick = () => this.reset();
    element("setpose").onclick = () => this.place();
    element("drive").onclick = () => this.drive();
    addEventListener("keydown", (event) => this.key(event, true));
    addEventListener("keyup", (event) => this.key(event, false));
    addEventListener("blur", () => this.keys.clear());
    setInterval(() => this.sendDrive(), DRIVE_MS);
  }

  offer({ commands, teleop }) {
    const live = Boolean(this.app.link);
    element("reset").hidden = element("setpose").hidden = !(live && commands);
    element("drive").hidden = !(live && teleop);
  }

  ask(question, word) {
    element("question").textContent = question;
    element("yes").textContent = word;
    const dialog = element("ask");
    dialog.returnValue = "no";
    dialog.showModal();
    return new Promise((resolve) => (dialog.onclose = () => resolve(dialog.returnValue === "yes")));
  }

  send(command) {
    if (!this.app.link?.send(command)) this.app.say("Not sent: there is no connection.", false);
  }

  async reset() {
    if (await this.ask("Restart all robots at their configured poses?", "Reset")) this.send({ do: "reset" });
  }

  // Press where the robot is, drag to where it looks, let go.
  place() {
    const { view } = this.app, robot = this.app.selected;
    this.app.say("Press where the robot is, drag towards where it looks, let go. Esc gives up.", true);
    view.canvas.classList.add("placing");
    const finish = () => {
      view.placing = null;
      view.canvas.classList.remove("placing");
    };
    view.placing = {
      begin: ([x, y]) => (this.placed = [x, y, 0]),
      turn: ([x, y]) => {
        if (this.placed && Math.hypot(x - this.placed[0], y - this.placed[1]) * view.scale > 6) {
          this.placed[2] = Math.atan2(y - this.placed[1], x - this.placed[0]);
        }
        this.app.touch();
      },
      cancel: () => {
        finish();
        this.placed = null;
        this.app.touch();
      },
      end: async () => {
        finish();
        const pose = this.placed, deg = ((pose[2] * 180) / Math.PI).toFixed(0);
        const name = this.app.swarm.names[robot];
        const sure = await this.ask(`Set ${name} to x ${pose[0].toFixed(3)} m, y ${pose[1].toFixed(3)} m, heading ${deg}°?`, "Set pose");
        this.placed = null;
        this.app.touch();
        if (sure) this.send({ do: "set_pose", robot, pose });
      },
    };
  }

  async drive() {
    const on = this.driven < 0 && (await this.ask(`Drive ${this.app.swarm.names[this.app.selected]} with the arrow keys?`, "Drive"));
    this.driven = on ? this.app.selected : -1;
    element("drive").setAttribute("aria-pressed", on);
    if (on) element("top").focus();
  }

  stop() {
    this.driven = -1;
    element("drive").setAttribute("aria-pressed", false);
  }

  key(event, down) {
    if (event.key === "Escape" && down) {
      this.app.view.placing?.cancel();
      this.stop();
    }
    if (this.driven < 0 || !KEYS[event.key]) return;
    event.preventDefault();
    if (down) this.keys.add(event.key);
    else this.keys.delete(event.key);
  }

  // As long as keys are held; the server lets a robot stand that it hears nothing for.
  sendDrive() {
    if (this.driven < 0 || !this.keys.size) return;
    let ahead = 0, left = 0;
    for (const key of this.keys) {
      ahead += KEYS[key][0];
      left += KEYS[key][1];
    }
    this.send({ do: "drive", robot: this.driven, ahead: Math.sign(ahead), left: Math.sign(left) });
  }
}
