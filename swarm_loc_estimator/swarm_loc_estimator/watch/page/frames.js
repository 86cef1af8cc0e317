// Frames: a header and columns of numbers, see frames.py.
const TYPES = { f8: Float64Array, f4: Float32Array, i4: Int32Array, u1: Uint8Array, i1: Int8Array };
const decoder = new TextDecoder();

function readFrame(buffer, begin = 0) {
  const size = new DataView(buffer).getUint32(begin, true);
  const header = JSON.parse(decoder.decode(new Uint8Array(buffer, begin + 4, size)));
  let at = begin + 4 + size;
  const columns = {};
  for (const [name, type, length] of header.columns) {
    columns[name] = new TYPES[type](buffer, at, length);
    at += Math.ceil(columns[name].byteLength / 8) * 8;
  }
  return { ...header, columns, bytes: at - begin };
}
