// What changes seldom: grid, map, landmarks, trails; painted again when the view moves, or a few times a second.
const TRAIL_MS = 15e3;
const FEW = 100;

class Ground {
  constructor(canvas, app) {
    this.canvas = canvas;
    this.app = app;
    this.stale = true;
    this.painted = 0;
    this.mapFrame = null;
    this.mapImage = null;
  }

  paint(now, time) {
    const { app, canvas } = this, many = app.count > FEW;
    if (!this.stale && now - this.painted < (many ? 1000 : 200)) return;
    if (this.stale && many && now - this.painted < 60) return; // a drag of a large swarm stays smooth
    this.stale = false;
    this.painted = now;
    const c = fitCanvas(canvas);
    c.fillStyle = app.colour("paper");
    c.fillRect(0, 0, app.view.width, app.view.height);
    if (app.shows.grid) this.grid(c);
    if (app.shows.map) this.map(c, time);
    if (app.shows.trails) this.trails(c, time);
    if (app.shows.landmarks) this.landmarks(c);
  }

  grid(c) {
    const { view } = this.app, wanted = 90 / view.scale, ten = 10 ** Math.floor(Math.log10(wanted));
    const step = ten * [1, 2, 5, 10].find((one) => one * ten >= wanted);
    const [left, top] = view.toWorld(0, 0), [right, bottom] = view.toWorld(view.width, view.height);
    c.strokeStyle = this.app.colour("grid");
    c.fillStyle = this.app.colour("soft");
    c.font = "11px system-ui, sans-serif";
    c.lineWidth = 1;
    c.beginPath();
    const text = (value) => `${+(Math.round(value / step) * step).toPrecision(6)} m`;
    for (let x = Math.ceil(left / step) * step; x < right; x += step) {
      const [u] = view.toScreen(x, 0);
      c.moveTo(u, 0);
      c.lineTo(u, view.height);
      c.fillText(text(x), u + 3, view.height - 52);
    }
    for (let y = Math.ceil(bottom / step) * step; y < top; y += step) {
      const [, v] = view.toScreen(0, y);
      c.moveTo(0, v);
      c.lineTo(view.width, v);
      c.fillText(text(y), 3, v - 3);
    }
    c.stroke();
  }

  map(c, time) {
    const frame = this.app.store.at("map", time);
    if (!frame) return;
    if (frame !== this.mapFrame) this.bake(frame);
    const { view } = this.app, [x, y, yaw] = frame.origin, [u, v] = view.toScreen(x, y);
    c.save();
    c.translate(u, v);
    c.rotate(-yaw);
    c.scale(view.scale * frame.resolution, -view.scale * frame.resolution);
    c.imageSmoothingEnabled = false;
    c.drawImage(this.mapImage, 0, 0);
    c.restore();
  }

  bake(frame) {
    const image = new ImageData(frame.width, frame.height), cells = frame.columns.cells;
    const [r, g, b] = rgb(this.app.colour("wall"));
    for (let k = 0; k < cells.length; k++) {
      image.data.set([r, g, b, cells[k] < 0 ? 40 : Math.round(cells[k] * 2.2)], 4 * k);
    }
    this.mapImage ||= document.createElement("canvas");
    this.mapImage.width = frame.width;
    this.mapImage.height = frame.height;
    this.mapImage.getContext("2d").putImageData(image, 0, 0);
    this.mapFrame = frame;
  }

  landmarks(c) {
    const { view, swarm } = this.app, some = swarm.landmarks.length <= 60;
    c.strokeStyle = c.fillStyle = this.app.colour("ink");
    c.font = "10px system-ui, sans-serif";
    c.lineWidth = 3;
    c.beginPath();
    for (const [id, x, y, yaw] of swarm.landmarks) {
      const [u, v] = view.toScreen(x, y);
      if (yaw === null) c.rect(u - 2, v - 2, 4, 4);
      else {
        const a = 6 * Math.cos(yaw), b = -6 * Math.sin(yaw);
        c.moveTo(u - b, v + a);
        c.lineTo(u + b, v - a);
        c.moveTo(u, v);
        c.lineTo(u + a, v + b);
      }
      if (some) c.fillText(id, u + 6, v - 6);
    }
    c.stroke();
  }

  trails(c, time) {
    const { view, store, count } = this.app, list = store.frames.poses || [], last = store.indexAt("poses", time);
    if (last < 1) return;
    const points = Math.max(6, Math.min(60, Math.round(12000 / count)));
    const first = Math.max(0, store.indexAt("poses", time - TRAIL_MS) + 1);
    const stride = Math.max(1, Math.ceil((last - first) / points));
    // an anchor that does not move with time: trails must not flicker
    const chosen = [];
    for (let k = last; k >= first; k--) if (k === last || Math.floor(list[k].stamp / (stride * 50)) !== Math.floor(list[k + 1].stamp / (stride * 50))) chosen.push(list[k].columns);
    c.strokeStyle = this.app.colour("tracked");
    c.globalAlpha = 0.45;
    c.lineWidth = 1.2;
    c.beginPath();
    const { scale } = view, dx = view.width / 2 - view.x * scale, dy = view.height / 2 + view.y * scale;
    for (let i = 0; i < count; i++) {
      let open = false;
      for (const { x, y } of chosen) {
        const u = x[i] * scale + dx, v = dy - y[i] * scale;
        if (!(u === u)) open = false;
        else if (open) c.lineTo(u, v);
        else { c.moveTo(u, v); open = true; }
      }
    }
    c.stroke();
    c.globalAlpha = 1;
  }
}

function fitCanvas(canvas) {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
  }
  const c = canvas.getContext("2d");
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  return c;
}

function rgb(colour) {
  const digits = colour.trim().slice(1);
  return [0, 2, 4].map((k) => parseInt(digits.slice(k, k + 2), 16));
}
