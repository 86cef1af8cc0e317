// Which part of the plane is shown: x to the right, y up, in metres; fingers and mouse move it.
class View {
  constructor(canvas, onChange) {
    this.canvas = canvas;
    this.onChange = onChange;
    this.x = 0;
    this.y = 0;
    this.scale = 100; // CSS pixels per metre
    this.touched = false;
    this.placing = null; // takes the pointer instead, while a pose is set
    this.onTap = () => {};
    this.onMove = () => {};
    this.pointers = new Map();
    const listen = (name, handler) => canvas.addEventListener(name, handler, { passive: false });
    listen("pointerdown", (event) => this.down(event));
    listen("pointermove", (event) => this.move(event));
    listen("pointerup", (event) => this.up(event));
    listen("pointercancel", (event) => this.up(event));
    listen("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), event.offsetX, event.offsetY);
    });
  }

  get width() { return this.canvas.clientWidth; }
  get height() { return this.canvas.clientHeight; }
  toScreen(x, y) { return [(x - this.x) * this.scale + this.width / 2, (this.y - y) * this.scale + this.height / 2]; }
  toWorld(u, v) { return [(u - this.width / 2) / this.scale + this.x, this.y - (v - this.height / 2) / this.scale]; }

  fit([left, bottom, right, top]) {
    const w = Math.max(right - left, 0.2), h = Math.max(top - bottom, 0.2);
    this.x = (left + right) / 2;
    this.y = (bottom + top) / 2;
    this.scale = 0.9 * Math.min(this.width / w, Math.max(this.height - 110, 50) / h);
    this.onChange();
  }

  zoom(factor, u, v) {
    const [x, y] = this.toWorld(u, v);
    this.scale = Math.min(Math.max(this.scale * factor, 0.02), 20000);
    const [a, b] = this.toWorld(u, v);
    this.x += x - a;
    this.y += y - b;
    this.touched = true;
    this.onChange();
  }

  center(x, y) {
    this.x = x;
    this.y = y;
    this.onChange();
  }

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.canvas.focus({ preventScroll: true });
    if (!this.pointers.size) this.moved = 0;
    else this.moved = Infinity; // two fingers tap nothing
    this.pointers.set(event.pointerId, { u: event.offsetX, v: event.offsetY });
    if (this.placing) this.placing.begin(this.toWorld(event.offsetX, event.offsetY));
  }

  move(event) {
    const pointer = this.pointers.get(event.pointerId);
    if (!pointer) return;
    const before = { ...pointer };
    pointer.u = event.offsetX;
    pointer.v = event.offsetY;
    const step = Math.hypot(pointer.u - before.u, pointer.v - before.v);
    this.moved += step;
    if (this.placing) return this.placing.turn(this.toWorld(pointer.u, pointer.v));
    if (this.pointers.size === 1) {
      if (this.moved < 4) return;
      this.canvas.classList.add("dragging");
      this.x -= (pointer.u - before.u) / this.scale;
      this.y += (pointer.v - before.v) / this.scale;
      this.touched = true;
      this.onMove();
      this.onChange();
    } else if (this.pointers.size === 2) {
      const other = [...this.pointers.values()].find((one) => one !== pointer);
      const was = Math.hypot(before.u - other.u, before.v - other.v);
      const is = Math.hypot(pointer.u - other.u, pointer.v - other.v);
      this.x -= (pointer.u - before.u) / 2 / this.scale; // what lies between the fingers stays there
      this.y += (pointer.v - before.v) / 2 / this.scale;
      this.onMove();
      if (was > 0) this.zoom(is / was, (pointer.u + other.u) / 2, (pointer.v + other.v) / 2);
    }
  }

  up(event) {
    if (!this.pointers.delete(event.pointerId)) return;
    this.canvas.classList.remove("dragging");
    if (this.placing) return event.type === "pointerup" ? this.placing.end() : this.placing.cancel();
    if (this.moved < 4 && event.type === "pointerup") this.onTap(event.offsetX, event.offsetY);
  }
}
