// The page: frames come in, the canvas is painted once per refresh of the screen when something has changed.
const LAYERS = { robots: null, names: "ink", ellipses: "ink", trails: "tracked", sightings: "used", truth: "truth", landmarks: "ink", map: "wall", goals: "goal", aerial: "aerial", grid: "grid" };
const SAMPLES = 2000;

class App {
  constructor() {
    this.swarm = { names: [], radius: [], infrared: [], landmarks: [] };
    this.store = new Store();
    this.selected = -1;
    this.following = false;
    this.paused = false;
    this.time = 0; // what is shown while paused, or while a recording plays
    this.speed = 1;
    this.metrics = { latency: [], frame: [] };
    this.shows = Object.fromEntries(Object.keys(LAYERS).map((name) => [name, true]));
    this.colours = {};
    this.dirty = true;
    this.view = new View(element("top"), () => this.touch());
    this.ground = new Ground(element("ground"), this);
    this.trails = new Trails(element("trails"), this);
    this.painter = new Painter(element("top"), this);
    this.panel = new Panel(this);
    this.link = null;
    this.actions = new Actions(this);
    this.view.onTap = (u, v) => this.pick(u, v);
    this.view.onMove = () => this.follow(false);
    this.controls();
    this.setTheme(localStorageOr("theme", matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
    new ResizeObserver(() => this.touch()).observe(element("stage"));
    requestAnimationFrame((now) => this.tick(now));
  }

  get count() { return this.swarm.names.length; }
  get shownTime() { return this.paused || this.playing ? this.time : this.store.range[1]; }
  colour(name) { return (this.colours[name] ||= getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim()); }
  touch() { this.dirty = this.ground.stale = this.trails.stale = true; }
  get settled() { return !this.dirty && !this.panel.later; }

  controls() {
    element("fit").onclick = () => this.fit();
    element("follow").onclick = () => this.follow(!this.following);
    element("pause").onclick = () => this.pause(!this.paused);
    element("theme").onclick = () => this.setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
    element("close").onclick = () => this.panel.select(-1);
    element("speed").onchange = (event) => (this.speed = Number(event.target.value));
    element("slider").oninput = (event) => this.seek(Number(event.target.value));
    element("layers").onclick = () => {
      const list = element("layerlist");
      list.hidden = !list.hidden;
      element("layers").setAttribute("aria-expanded", !list.hidden);
    };
    for (const [name, colour] of Object.entries(LAYERS)) if (colour) {
      const label = document.createElement("label"), box = document.createElement("input"), sample = document.createElement("i");
      box.type = "checkbox";
      box.checked = true;
      box.onchange = () => {
        this.shows[name] = box.checked;
        this.touch();
      };
      sample.style.background = name === "sightings" ? "linear-gradient(90deg, var(--used) 33%, var(--kept) 33% 66%, var(--gated) 66%)" : `var(--${colour})`;
      if (name === "sightings") label.title = "used, waiting, gated; infrared links are dashed";
      label.append(box, sample, name);
      element("layerlist").append(label);
    }
    addEventListener("keydown", (event) => {
      if (event.target.matches("input, select, button, dialog *")) return;
      if (event.key === " ") this.pause(!this.paused);
      else if (event.key === "f") this.fit();
      else if (event.key === "Escape") this.panel.select(-1);
      else return;
      event.preventDefault();
    });
  }

  setTheme(theme) {
    document.documentElement.dataset.theme = theme;
    try { localStorage.setItem("theme", theme); } catch { /* a file need not remember */ }
    this.colours = {};
    this.ground.mapFrame = null;
    this.panel.restyle();
    this.counted = "";
    this.touch();
  }

  setLink(state) {
    const chip = element("link");
    chip.textContent = { live: "live", lost: "connection lost, trying again", recorded: "recording" }[state];
    chip.dataset.state = state;
  }

  say(text, ok) {
    const box = element("said");
    box.textContent = text;
    box.classList.toggle("bad", !ok);
    box.hidden = false;
    clearTimeout(this.hush);
    this.hush = setTimeout(() => (box.hidden = true), 6000);
  }

  onNote(note) {
    if (note.kind === "about") this.onAbout(note);
    else if (note.kind === "report") this.panel.onReport(note);
    else if (note.kind === "said") this.say(note.text, note.ok);
    else if (note.kind === "reset") this.store.clear();
  }

  onAbout(about) {
    if (about.names.join() !== this.swarm.names.join()) this.store.clear();
    this.swarm = about;
    element("title").textContent = document.title = about.title;
    this.actions.offer(about);
    if (this.selected >= 0) this.link?.send({ do: "select", robot: this.selected });
    this.touch();
  }

  onFrame(frame) {
    frame.received = Date.now();
    this.store.add(frame);
    if (frame.kind === "poses" && !this.paused) {
      this.dirty = true;
      if (!this.view.touched && !this.following && located(frame) > (this.fitted || 0)) this.fitted = this.fit();
    } else if (frame.kind === "map") {
      if (!this.view.touched && this.fitted && !this.following) this.fit(); // it grows
      this.touch();
    }
  }

  // Show everything that has a place now and in the end; how many robots have one.
  fit() {
    const xs = [], ys = [];
    for (const [, x, y] of this.swarm.landmarks) { xs.push(x); ys.push(y); }
    const map = this.store.at("map", this.playing ? Infinity : this.shownTime);
    for (const [x, y] of map ? knownCorners(map) : []) { xs.push(x); ys.push(y); }
    let most = 0;
    for (const time of [this.shownTime, this.store.range[1]]) {
      const poses = this.store.at("poses", time);
      if (poses) for (let i = 0; i < this.count; i++) if (poses.columns.status[i]) {
        xs.push(poses.columns.x[i]);
        ys.push(poses.columns.y[i]);
      }
      if (poses) most = Math.max(most, located(poses));
    }
    if (!xs.length) return 0;
    const low = (list) => list.reduce((a, b) => Math.min(a, b)), high = (list) => list.reduce((a, b) => Math.max(a, b));
    this.follow(false);
    const room = 2.5 * high(this.swarm.radius);
    this.view.fit([low(xs) - room, low(ys) - room, high(xs) + room, high(ys) + room]);
    return most;
  }

  follow(on) {
    this.following = on && this.selected >= 0;
    element("follow").setAttribute("aria-pressed", this.following);
    if (on && !this.following) this.say("Choose a robot first.", true);
    this.dirty = true;
  }

  pick(u, v) {
    const { painter } = this;
    let best = -1, nearest = 20;
    for (let i = 0; i < (painter.u || []).length; i++) {
      const distance = Math.hypot(painter.u[i] - u, painter.v[i] - v) - painter.radius(i);
      if (distance < nearest) [best, nearest] = [i, distance];
    }
    this.panel.select(best);
    if (best < 0) this.follow(false);
    this.dirty = true;
  }

  pause(on) {
    if (!on && this.playing && this.time >= this.store.range[1]) this.time = this.store.range[0];
    if (on && !this.playing) this.time = this.store.range[1];
    this.paused = on;
    element("pause").textContent = on ? (this.playing ? "Play" : "Live") : "Pause";
    this.touch();
  }

  // Go to a share of the time that is known.
  seek(share) {
    const [first, last] = this.store.range;
    if (share >= 1 && !this.playing) return this.pause(false);
    if (!this.paused) this.pause(true);
    this.time = first + share * (last - first);
    this.touch();
  }

  play({ about, frames }) {
    this.playing = this.store.unbounded = true;
    this.setLink("recorded");
    this.onAbout(about);
    for (const frame of frames) this.store.add(frame);
    const begun = (this.store.frames.poses || []).find((frame) => frame.columns.status.some(Boolean));
    this.time = begun ? begun.stamp : this.store.range[0]; // not where nobody is located yet
    element("speed").hidden = false;
    this.fitted = this.fit();
    this.pause(true);
  }

  tick(now) {
    const elapsed = now - (this.ticked ?? now), [first, last] = this.store.range;
    this.ticked = now;
    if (this.playing && !this.paused) {
      this.time = Math.min(this.time + elapsed * this.speed, last);
      this.dirty = true;
      if (this.time >= last) this.pause(true);
    }
    if (this.dirty) this.paint(now, first, last);
    requestAnimationFrame((next) => this.tick(next));
  }

  paint(now, first, last) {
    this.dirty = false;
    const begin = performance.now(), time = this.shownTime;
    if (this.following) this.keepInTheMiddle(time);
    this.ground.paint(time);
    const others = this.trails.paint(now, time), poses = this.painter.paint(time);
    this.panel.paint(now, time, others);
    this.bars(time, first, last, poses);
    if (poses) this.measure(poses, begin);
  }

  keepInTheMiddle(time) {
    const poses = this.store.at("poses", time), i = this.selected;
    if (i < 0) return this.follow(false);
    if (poses && poses.columns.status[i]) {
      this.view.x = poses.columns.x[i];
      this.view.y = poses.columns.y[i];
      this.ground.stale = this.trails.stale = true;
    }
  }

  bars(time, first, last, poses) {
    const slider = element("slider"), share = last > first ? (time - first) / (last - first) : 1;
    if (document.activeElement !== slider || !this.paused) if (slider.value !== String(share)) slider.value = share;
    const behind = (time - last) / 1e3;
    const text = this.playing ? `${((time - first) / 1e3).toFixed(1)} of ${((last - first) / 1e3).toFixed(1)} s` : behind > -0.05 ? "now" : `${behind.toFixed(1)} s`;
    if (text !== this.timeText) element("time").textContent = this.timeText = text; // else the page would be laid out again
    const counts = STATUS.map(() => 0);
    if (poses) for (const status of poses.columns.status) counts[status]++;
    if (counts.join() === this.counted) return;
    this.counted = counts.join();
    element("counts").replaceChildren(...STATUS.flatMap((name, k) => (counts[k] ? [chip(counts[k], name, this.colour(name), () => this.next(k))] : [])));
  }

  // Choose the next robot with a status: those that are not located have no place to click at.
  next(status) {
    const poses = this.store.at("poses", this.shownTime), n = this.count;
    for (let i = 1; i <= n; i++) {
      const robot = (this.selected + i) % n;
      if (poses?.columns.status[robot] === status) return this.panel.select(robot), this.touch();
    }
  }

  // How long painting took, and how old each new pose was when it was on the screen: when the task after it runs.
  measure(poses, begin) {
    const isNew = poses !== this.measured && !this.playing && !this.paused;
    this.measured = poses;
    const channel = new MessageChannel();
    channel.port1.onmessage = () => {
      push(this.metrics.frame, performance.now() - begin);
      if (isNew && poses.received) push(this.metrics.latency, performance.timeOrigin + performance.now() - poses.stamp);
    };
    channel.port2.postMessage(0);
  }
}

function located({ columns: { status } }) {
  let count = 0;
  for (let i = 0; i < status.length; i++) if (status[i]) count++;
  return count;
}

function push(list, value) {
  list.push(value);
  if (list.length > SAMPLES) list.shift();
}

function chip(count, name, colour, onclick) {
  const button = document.createElement("button"), dot = document.createElement("i");
  Object.assign(button, { className: "chip", title: "Choose the next of them", onclick });
  dot.style.background = colour;
  button.append(dot, `${count} ${name}`);
  return button;
}

function localStorageOr(key, value) {
  try { return localStorage.getItem(key) || value; } catch { return value; }
}

const app = (window.watch = new App());
const recording = element("recording");
if (recording) readRecording(recording.textContent).then((run) => app.play(run));
else {
  app.link = new Link(app);
}
