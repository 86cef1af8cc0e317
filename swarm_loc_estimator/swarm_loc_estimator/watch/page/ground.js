// What changes seldom: grid, map, landmarks; painted again when the view moves or another map comes.

class Ground {
  constructor(canvas, app) {
    this.canvas = canvas;
    this.app = app;
    this.stale = true;
    this.mapFrame = null;
    this.mapImage = null;
  }

  paint(time) {
    const { app } = this, map = app.shows.map ? app.store.at("map", time) : null;
    if (!this.stale && map === this.paintedMap) return;
    this.stale = false;
    this.paintedMap = map;
    const c = fitCanvas(this.canvas, { alpha: false });
    c.fillStyle = app.colour("paper");
    c.fillRect(0, 0, app.view.width, app.view.height);
    if (app.shows.grid) this.grid(c);
    if (map) this.map(c, map);
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
      if (v > 60) c.fillText(text(y), 3, v - 3); // above it is the header
    }
    c.stroke();
  }

  map(c, frame) {
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
    const pixels = new Uint32Array(image.data.buffer), [r, g, b] = rgb(this.app.colour("wall"));
    for (let k = 0; k < cells.length; k++) {
      const opacity = cells[k] < 0 ? 40 : Math.round(cells[k] * 2.2);
      pixels[k] = (opacity << 24) | (b << 16) | (g << 8) | r;
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
}

// Corners, in the plane, of the part of a map that is known.
function knownCorners({ width, height, resolution, origin: [x, y, yaw], columns: { cells } }) {
  let left = width, right = -1, bottom = height, top = -1;
  for (let row = 0, k = 0; row < height; row++) for (let column = 0; column < width; column++, k++) if (cells[k] >= 0) {
    left = Math.min(left, column);
    right = Math.max(right, column);
    bottom = Math.min(bottom, row);
    top = Math.max(top, row);
  }
  if (right < 0) return [];
  const c = resolution * Math.cos(yaw), s = resolution * Math.sin(yaw);
  return [[left, bottom], [right + 1, bottom], [left, top + 1], [right + 1, top + 1]].map(([a, b]) => [x + c * a - s * b, y + s * a + c * b]);
}

function fitCanvas(canvas, options) {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
  }
  const c = canvas.getContext("2d", options);
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  return c;
}

function rgb(colour) {
  const digits = colour.trim().slice(1);
  return [0, 2, 4].map((k) => parseInt(digits.slice(k, k + 2), 16));
}
