// What moves: robots with heading and 95 % ellipse, what each sees, ground truth, goals, aerial detections.
const STATUS = ["waiting", "tracked", "stale", "unconfirmed", "contradicted", "uncertain"];
const VERDICT = ["kept", "used", "gated", "kept", "kept"]; // by number, as a colour; 0, 3 and 4 wait
const CHI2_95 = 5.991; // of two degrees of freedom
const SEEN_MS = 1500;
const LABELLED = 60;

class Painter {
  constructor(canvas, app) {
    this.canvas = canvas;
    this.app = app;
  }

  paint(time) {
    const { app } = this, c = fitCanvas(this.canvas);
    c.clearRect(0, 0, app.view.width, app.view.height);
    const poses = app.store.at("poses", time);
    if (!poses) return null;
    this.screen(poses.columns);
    if (app.shows.truth) this.truth(c, app.store.at("truth", time, SEEN_MS));
    if (app.shows.sightings) this.sightings(c, app.store.at("sightings", time, SEEN_MS));
    if (app.shows.goals) this.goals(c, app.store.at("goals", time));
    if (app.shows.aerial) this.aerial(c, app.store.at("aerial", time, SEEN_MS));
    if (app.shows.ellipses) this.ellipses(c, poses.columns);
    this.robots(c, poses.columns);
    if (app.actions.placed) this.placed(c, app.actions.placed);
    return poses;
  }

  // Where all robots are on the screen.
  screen({ x, y }) {
    const { view } = this.app, n = x.length;
    if (!this.u || this.u.length !== n) {
      this.u = new Float32Array(n);
      this.v = new Float32Array(n);
    }
    const dx = view.width / 2 - view.x * view.scale, dy = view.height / 2 + view.y * view.scale;
    for (let i = 0; i < n; i++) {
      this.u[i] = x[i] * view.scale + dx;
      this.v[i] = dy - y[i] * view.scale;
    }
  }

  isSeen(i, margin = 30) {
    const u = this.u[i], v = this.v[i], { view } = this.app;
    return u > -margin && v > -margin && u < view.width + margin && v < view.height + margin;
  }

  radius(i) {
    const { view, swarm, count } = this.app;
    return Math.max(swarm.radius[i] * view.scale, count > 300 ? 2.5 : 4);
  }

  robots(c, { theta, status, known }) {
    const { app } = this, n = theta.length;
    for (let k = 1; k < STATUS.length; k++) {
      c.fillStyle = app.colour(STATUS[k]);
      c.beginPath();
      for (let i = 0; i < n; i++) if (status[i] === k && this.isSeen(i)) {
        const r = this.radius(i);
        c.moveTo(this.u[i] + r, this.v[i]);
        c.arc(this.u[i], this.v[i], r, 0, 2 * Math.PI);
      }
      c.fill();
    }
    c.strokeStyle = app.colour("ink");
    c.lineWidth = n > 300 ? 1 : 2;
    c.beginPath();
    for (let i = 0; i < n; i++) {
      if (!known[i] || !this.isSeen(i)) continue;
      const reach = 1.7 * this.radius(i);
      c.moveTo(this.u[i], this.v[i]);
      c.lineTo(this.u[i] + reach * Math.cos(theta[i]), this.v[i] - reach * Math.sin(theta[i]));
    }
    c.stroke();
    this.labels(c, status);
    const chosen = app.selected;
    if (chosen < 0 || !status[chosen]) return;
    c.strokeStyle = app.colour("ink");
    c.lineWidth = 2;
    c.beginPath();
    c.arc(this.u[chosen], this.v[chosen], this.radius(chosen) + 5, 0, 2 * Math.PI);
    c.stroke();
  }

  labels(c, status) {
    const { app } = this, seen = [];
    for (let i = 0; i < status.length && seen.length <= LABELLED; i++) if (status[i] && this.isSeen(i, 0)) seen.push(i);
    const shown = seen.length <= LABELLED && app.shows.names ? seen : [];
    if (app.selected >= 0 && !shown.includes(app.selected)) shown.push(app.selected);
    c.font = "12px system-ui, sans-serif";
    c.fillStyle = app.colour("ink");
    for (const i of shown) if (status[i]) c.fillText(app.swarm.names[i], this.u[i] + this.radius(i) + 4, this.v[i] - this.radius(i));
  }

  ellipses(c, { sxx, sxy, syy, status }) {
    const { app } = this, k = Math.sqrt(CHI2_95) * app.view.scale;
    c.strokeStyle = app.colour("ink");
    c.globalAlpha = 0.7;
    c.lineWidth = 1;
    c.beginPath();
    for (let i = 0; i < sxx.length; i++) {
      if (!status[i] || !this.isSeen(i, 2000)) continue;
      const middle = (sxx[i] + syy[i]) / 2, half = Math.hypot((sxx[i] - syy[i]) / 2, sxy[i]);
      const a = k * Math.sqrt(middle + half), b = k * Math.sqrt(Math.max(middle - half, 0));
      if (!(a > 1) || a > 1e5 || (sxx.length > 300 && a < this.radius(i))) continue; // it would lie on the disc
      const angle = -0.5 * Math.atan2(2 * sxy[i], sxx[i] - syy[i]);
      c.moveTo(this.u[i] + a * Math.cos(angle), this.v[i] + a * Math.sin(angle));
      c.ellipse(this.u[i], this.v[i], a, b, angle, 0, 2 * Math.PI);
    }
    c.stroke();
    c.globalAlpha = 1;
  }

  sightings(c, frame) {
    if (!frame) return;
    const { app } = this, { observer, target, verdict } = frame.columns;
    const only = app.count > 100 && app.selected >= 0 ? app.selected : -1;
    c.lineWidth = 1.2;
    for (const infrared of [0, 1]) {
      c.setLineDash(infrared ? [5, 4] : []);
      for (const colour of ["used", "kept", "gated"]) {
        c.strokeStyle = app.colour(colour);
        c.globalAlpha = colour === "used" && app.count > 30 ? 0.35 : 0.8;
        c.beginPath();
        for (let k = 0; k < observer.length; k++) {
          const from = observer[k], to = target[k];
          if (from < 0 || VERDICT[verdict[k]] !== colour || app.swarm.infrared[from] !== infrared) continue;
          if (only >= 0 && from !== only && to !== only) continue;
          const mark = to < 0 ? app.swarm.landmarks[-1 - to] : null;
          const [u, v] = mark ? app.view.toScreen(mark[1], mark[2]) : [this.u[to], this.v[to]];
          if (!(this.u[from] === this.u[from]) || !(u === u)) continue;
          c.moveTo(this.u[from], this.v[from]);
          c.lineTo(u, v);
        }
        c.stroke();
      }
    }
    c.setLineDash([]);
    c.globalAlpha = 1;
  }

  truth(c, frame) {
    if (!frame) return;
    const { view } = this.app, { robot, x, y, theta } = frame.columns;
    c.strokeStyle = this.app.colour("truth");
    c.globalAlpha = 0.6;
    c.lineWidth = 1.5;
    c.beginPath();
    for (let k = 0; k < robot.length; k++) {
      const [u, v] = view.toScreen(x[k], y[k]), r = this.radius(robot[k]) + 2;
      c.moveTo(u + r, v);
      c.arc(u, v, r, 0, 2 * Math.PI);
      c.moveTo(u, v);
      c.lineTo(u + r * Math.cos(theta[k]), v - r * Math.sin(theta[k]));
    }
    c.stroke();
    c.globalAlpha = 1;
  }

  goals(c, frame) {
    if (!frame) return;
    const { view } = this.app, { robot, x, y } = frame.columns;
    c.strokeStyle = this.app.colour("goal");
    c.lineWidth = 1.5;
    c.setLineDash([2, 3]);
    c.beginPath();
    for (let k = 0; k < robot.length; k++) {
      const [u, v] = view.toScreen(x[k], y[k]);
      c.moveTo(this.u[robot[k]], this.v[robot[k]]);
      c.lineTo(u, v);
      c.moveTo(u - 5, v - 5);
      c.lineTo(u + 5, v + 5);
      c.moveTo(u - 5, v + 5);
      c.lineTo(u + 5, v - 5);
    }
    c.stroke();
    c.setLineDash([]);
  }

  aerial(c, frame) {
    if (!frame) return;
    const { view, swarm } = this.app, { robot, x, y } = frame.columns, sure = frame.columns.probability;
    c.strokeStyle = c.fillStyle = this.app.colour("aerial");
    c.lineWidth = 1.5;
    c.font = "11px system-ui, sans-serif";
    c.beginPath();
    for (let k = 0; k < robot.length; k++) {
      const [u, v] = view.toScreen(x[k], y[k]);
      c.rect(u - 7, v - 7, 14, 14);
      const text = robot[k] < 0 ? "?" : `${swarm.names[robot[k]]} ${Math.round(100 * sure[k])} %`;
      c.fillText(text, u + 9, v + 16);
    }
    c.stroke();
  }

  placed(c, [x, y, theta]) {
    const [u, v] = this.app.view.toScreen(x, y);
    c.strokeStyle = this.app.colour("contradicted");
    c.lineWidth = 2;
    c.beginPath();
    c.arc(u, v, 10, 0, 2 * Math.PI);
    c.moveTo(u, v);
    c.lineTo(u + 26 * Math.cos(theta), v - 26 * Math.sin(theta));
    c.stroke();
  }
}
