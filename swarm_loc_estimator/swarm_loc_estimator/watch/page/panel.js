// The numbers and curves of one robot.
const CURVE_MS = 60e3;
const CURVE_POINTS = 300;
const PAINT_MS = 200;
const CURVE_PERIOD_MS = 1000;
const SAY_STATUS = {
  waiting: "waits for a sighting or a fix that locates it",
  tracked: "tracked",
  stale: "its odometry is silent: the last known pose",
  unconfirmed: "located, but nothing measured since agrees with its pose",
  contradicted: "its newest sightings do not agree with its pose",
  uncertain: "its position is uncertain beyond the limit: too long unseen",
};

class Panel {
  constructor(app) {
    this.app = app;
    this.values = {};
    this.nis = [];
    this.plots = null;
    this.later = 0;
    this.renew();
  }

  // Nothing that is painted holds any more.
  renew() {
    this.painted = this.drawn = -Infinity;
    this.numbersAt = this.curvesAt = NaN;
  }

  select(robot) {
    const { app } = this;
    app.selected = robot;
    this.values = {};
    this.nis = [];
    element("panel").hidden = robot < 0;
    if (robot >= 0) {
      element("name").textContent = app.swarm.names[robot];
      element("message").textContent = "";
      element("values").replaceChildren();
    }
    element("more").hidden = !app.link;
    if (app.link) app.link.send({ do: "select", robot });
    this.renew();
  }

  // What /diagnostics says of the robot that is shown.
  onReport({ robot, stamp, message, values }) {
    if (robot !== this.app.selected) return;
    this.values = values;
    const nis = Number(values["NIS mean"]);
    if (Number.isFinite(nis)) this.nis.push([stamp, nis]);
    if (this.nis.length > CURVE_POINTS) this.nis.shift();
    element("message").textContent = message;
    fill(element("values"), Object.entries(values));
  }

  // Numbers and curves in turn, and no curves beside much else, so that no single painting takes long.
  paint(now, time, others) {
    const i = this.app.selected, poses = i < 0 ? null : this.app.store.at("poses", time);
    if (!poses) return;
    if (now - this.painted >= PAINT_MS && this.numbersAt !== time) {
      this.painted = now;
      this.numbersAt = time;
      this.numbers(poses, time, i);
    } else if (now - this.drawn >= CURVE_PERIOD_MS && this.curvesAt !== time && !others) {
      this.drawn = now;
      this.curvesAt = time;
      this.curves(time, i);
    }
    if (this.numbersAt !== time || this.curvesAt !== time) this.paintLater();
  }

  numbers(poses, time, i) {
    const { app } = this;
    const p = poses.columns, status = STATUS[p.status[i]];
    if (!app.link) element("message").textContent = (status === "waiting" && this.loss(time, i)) || SAY_STATUS[status];
    const rows = [["status", status]];
    if (p.status[i]) {
      const deg = 180 / Math.PI;
      const turned = Math.atan2(Math.sin(p.theta[i]), Math.cos(p.theta[i]));
      rows.push(["x", `${p.x[i].toFixed(3)} m`], ["y", `${p.y[i].toFixed(3)} m`], ["heading", p.known[i] ? `${(turned * deg).toFixed(1)}°` : "unknown"]);
      rows.push(["σ x, y", `${mm(p.sxx[i])}, ${mm(p.syy[i])} mm`], ["σ heading", `${(Math.sqrt(p.stt[i]) * deg).toFixed(2)}°`]);
      if (p.age[i] === p.age[i]) rows.push(["age of its own fix", p.age[i] < 0 ? "never" : `${p.age[i].toFixed(1)} s`]);
      const error = this.newestError(time, i);
      if (error !== null) rows.push(["off the ground truth", `${(1e3 * error).toFixed(1)} mm`]);
    }
    for (const [verdict, count] of this.counts(app.store.at("sightings", time, SEEN_MS), i)) rows.push([`sightings ${verdict}`, count]);
    fill(element("numbers"), rows);
  }

  // Why a robot of a recording is not located any more; "" if it never was.
  loss(time, i) {
    const last = (this.app.swarm.losses || []).filter(([robot, stamp]) => robot === i && stamp <= time).pop();
    return last ? `lost ${((time - last[1]) / 1e3).toFixed(1)} s ago: ${last[2]}` : "";
  }

  // What has changed since the last time is not forgotten, only not painted at once.
  paintLater() {
    this.later ||= setTimeout(() => { this.later = 0; this.app.dirty = true; }, PAINT_MS);
  }

  // Distance of a pose from the ground truth, which is interpolated to its stamp [m]; null: not known.
  error({ stamp, columns }, i) {
    const { store } = this.app, k = store.indexAt("truth", stamp), list = store.frames.truth || [];
    if (k < 0 || k + 1 >= list.length) return null;
    const [a, b] = [list[k], list[k + 1]], m = a.columns.robot.indexOf(i), n = b.columns.robot.indexOf(i);
    if (m < 0 || n < 0 || b.stamp - a.stamp > SEEN_MS) return null;
    const share = (stamp - a.stamp) / (b.stamp - a.stamp), between = (name) => (1 - share) * a.columns[name][m] + share * b.columns[name][n];
    const distance = Math.hypot(columns.x[i] - between("x"), columns.y[i] - between("y"));
    return distance === distance ? distance : null;
  }

  newestError(time, i) {
    const { store } = this.app, list = store.frames.poses, last = store.indexAt("poses", time);
    for (let k = last; k >= 0 && k > last - 20; k--) {
      const error = this.error(list[k], i);
      if (error !== null) return error;
    }
    return null;
  }

  counts(frame, i) {
    const found = new Map();
    if (!frame) return found;
    const { observer, verdict } = frame.columns, say = { used: "used", gated: "gated", kept: "waiting" };
    for (let k = 0; k < observer.length; k++) if (observer[k] === i) {
      const name = say[VERDICT[verdict[k]]];
      found.set(name, (found.get(name) || 0) + 1);
    }
    return found;
  }

  curves(time, i) {
    const { store } = this.app, list = store.frames.poses, last = store.indexAt("poses", time);
    const first = Math.max(0, store.indexAt("poses", time - CURVE_MS)), stride = Math.ceil((last - first + 1) / CURVE_POINTS);
    const t = [], sigma = [], error = [];
    for (let k = first; k <= last; k += stride) {
      const p = list[k].columns;
      t.push((list[k].stamp - time) / 1e3);
      sigma.push(p.status[i] ? 1e3 * Math.sqrt((p.sxx[i] + p.syy[i]) / 2) : null);
      const off = this.error(list[k], i);
      error.push(off === null ? null : 1e3 * off);
    }
    const nis = this.nis.filter(([stamp]) => stamp <= time && stamp > time - CURVE_MS);
    this.plots ||= [this.plot(["σ [mm]", "error [mm]"], ["tracked", "gated"]), this.app.link ? this.plot(["mean NIS"], ["kept"]) : null];
    this.plots[0].setData([t, sigma, error]);
    if (this.plots[1]) this.plots[1].setData([nis.map(([stamp]) => (stamp - time) / 1e3), nis.map(([, value]) => value)]);
  }

  plot(labels, colours) {
    const { app } = this, ink = { stroke: app.colour("soft"), grid: { stroke: app.colour("grid") }, font: "10px system-ui" };
    const series = labels.map((label, k) => ({ label, stroke: app.colour(colours[k]), width: 1.5, points: { show: false } }));
    const options = { width: element("panel").clientWidth - 30, height: 110, series: [{}, ...series], scales: { x: { time: false } }, axes: [{ ...ink, space: 60, values: (_, ticks) => ticks.map((tick) => `${tick} s`) }, { ...ink, size: 38, space: 25 }], cursor: { show: false }, legend: { live: false } };
    return new uPlot(options, [[], ...labels.map(() => [])], element("curves"));
  }

  // Colours have changed.
  restyle() {
    if (this.plots) for (const plot of this.plots) plot?.destroy();
    this.plots = null;
    this.renew();
  }
}

function mm(variance) {
  const value = 1e3 * Math.sqrt(variance);
  return value < 100 ? value.toFixed(1) : value.toFixed(0);
}

function element(id) {
  return document.getElementById(id);
}

// Only what has changed: else the whole page would be laid out again.
function fill(table, rows) {
  while (table.rows.length > rows.length) table.deleteRow(-1);
  rows.forEach((row, k) => {
    const tr = table.rows[k] || table.insertRow();
    row.forEach((text, n) => {
      const td = tr.cells[n] || tr.insertCell();
      if (td.textContent !== String(text)) td.textContent = text;
    });
  });
}
