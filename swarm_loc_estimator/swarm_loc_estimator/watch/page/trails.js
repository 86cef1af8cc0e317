// Paths of the last seconds, written pixel by pixel: without a GPU, lines of a canvas with ten thousand corners take
// many times as long. They have a canvas of their own, and are written a few times a second.
const TRAIL_MS = 15e3;
const TRAIL_PERIOD_MS = 200;
const TRAIL_OPACITY = 130;

class Trails {
  constructor(canvas, app) {
    this.canvas = canvas;
    this.app = app;
    this.context = canvas.getContext("2d", { willReadFrequently: true });
    this.stale = true;
    this.painted = 0;
  }

  // Whether anything was painted.
  paint(now, time) {
    const { app, canvas } = this, w = Math.max(app.view.width, 1), h = Math.max(app.view.height, 1);
    if (!this.stale && (now - this.painted < TRAIL_PERIOD_MS || time === this.time)) return false;
    this.stale = false;
    this.painted = now;
    this.time = time;
    if (!this.image || canvas.width !== w || canvas.height !== h) {
      canvas.width = w;
      canvas.height = h;
      this.image = this.context.createImageData(w, h);
      this.pixels = new Uint32Array(this.image.data.buffer);
    }
    this.pixels.fill(0);
    if (app.shows.trails) this.write(time);
    this.context.putImageData(this.image, 0, 0);
    return true;
  }

  write(time) {
    const { view, store, count } = this.app, chosen = this.chosen(store.frames.poses || [], time);
    const [r, g, b] = rgb(this.app.colour("tracked"));
    this.colour = (b << 16) | (g << 8) | r;
    const { scale } = view, dx = view.width / 2 - view.x * scale, dy = view.height / 2 + view.y * scale;
    for (let i = 0; i < count; i++) {
      let u = NaN, v = NaN;
      for (const { x, y } of chosen) {
        const p = x[i] * scale + dx, q = dy - y[i] * scale;
        if (u === u && p === p) this.line(u, v, p, q);
        [u, v] = [p, q];
      }
    }
  }

  // Columns of poses, as many as so many robots bear; by stamps that do not move with time, or trails would flicker.
  chosen(list, time) {
    const { store, count } = this.app, last = store.indexAt("poses", time), first = Math.max(0, store.indexAt("poses", time - TRAIL_MS) + 1);
    const stride = Math.max(1, Math.ceil((last - first) / Math.max(6, Math.min(60, Math.round(12000 / count))))), found = [];
    const slot = (k) => Math.floor(list[k].stamp / (stride * 50));
    for (let k = last; k >= first; k--) if (k === last || slot(k) !== slot(k + 1)) found.push(list[k].columns);
    return found;
  }

  // One pixel wide, shared by the two pixels that it runs between.
  line(u, v, p, q) {
    const w = this.canvas.width, h = this.canvas.height;
    let begin = 0, end = 1;
    for (let axis = 0; axis < 2; axis++) { // what of it is on the screen
      const from = axis ? v : u, step = axis ? q - v : p - u, size = axis ? h : w;
      if (step === 0 && (from < 0 || from > size)) return;
      if (step === 0) continue;
      const a = -from / step, b = (size - from) / step;
      begin = Math.max(begin, Math.min(a, b));
      end = Math.min(end, Math.max(a, b));
    }
    if (begin >= end) return;
    const steep = Math.abs(q - v) > Math.abs(p - u);
    const u0 = u + begin * (p - u), v0 = v + begin * (q - v), u1 = u + end * (p - u), v1 = v + end * (q - v);
    const count = Math.ceil(Math.max(Math.abs(u1 - u0), Math.abs(v1 - v0))) || 1;
    const stepU = (u1 - u0) / count, stepV = (v1 - v0) / count;
    for (let k = 0; k < count; k++) {
      const across = (steep ? u0 + k * stepU : v0 + k * stepV) - 0.5, along = Math.floor(steep ? v0 + k * stepV : u0 + k * stepU);
      const near = Math.floor(across), share = across - near;
      if (steep) {
        this.put(near, along, 1 - share);
        this.put(near + 1, along, share);
      } else {
        this.put(along, near, 1 - share);
        this.put(along, near + 1, share);
      }
    }
  }

  put(u, v, share) {
    if (u < 0 || v < 0 || u >= this.canvas.width || v >= this.canvas.height) return;
    const place = v * this.canvas.width + u, opacity = TRAIL_OPACITY * share;
    if (this.pixels[place] >>> 24 < opacity) this.pixels[place] = (opacity << 24) | this.colour;
  }
}
