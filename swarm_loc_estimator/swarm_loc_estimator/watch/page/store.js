// What is known of the last minutes: the frames of each kind in the order of their stamps.
const SPAN_MS = 300e3;
const MAX_BYTES = 192e6;

class Store {
  constructor() {
    this.unbounded = false;
    this.clear();
  }

  clear() {
    this.frames = {};
    this.bytes = 0;
    this.selectedValues = [];
  }

  add(frame) {
    const list = (this.frames[frame.kind] ||= []);
    let place = list.length;
    while (place > 0 && list[place - 1].stamp > frame.stamp) place--;
    if (place > 0 && list[place - 1].stamp === frame.stamp) list[place - 1] = frame;
    else {
      list.splice(place, 0, frame);
      this.bytes += frame.bytes;
    }
    if (!this.unbounded) this.trim(list);
  }

  trim(list) {
    const last = list[list.length - 1].stamp;
    let count = 0;
    while (count < list.length - 1 && (last - list[count].stamp > SPAN_MS || this.bytes > MAX_BYTES)) {
      this.bytes -= list[count].bytes;
      count++;
    }
    if (count) list.splice(0, count);
  }

  // Index of the newest frame of a kind that is no newer than a time; -1: none.
  indexAt(kind, time) {
    const list = this.frames[kind] || [];
    let low = 0, high = list.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (list[middle].stamp <= time) low = middle + 1;
      else high = middle;
    }
    return low - 1;
  }

  // The newest frame no newer than a time, and no older than so many milliseconds.
  at(kind, time, maxAge = Infinity) {
    const k = this.indexAt(kind, time);
    const frame = k < 0 ? null : this.frames[kind][k];
    return frame && time - frame.stamp <= maxAge ? frame : null;
  }

  get range() {
    const list = this.frames.poses || [];
    return list.length ? [list[0].stamp, list[list.length - 1].stamp] : [0, 0];
  }
}
