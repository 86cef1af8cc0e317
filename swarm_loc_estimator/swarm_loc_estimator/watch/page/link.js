// Where frames come from: the server's WebSocket, which is opened again when it breaks, or a recording in the page.
const AGAIN_MS = [250, 500, 1000, 2000];

class Link {
  constructor(app) {
    this.app = app;
    this.tries = 0;
    this.open();
  }

  open() {
    const { app } = this;
    const address = new URL("socket", location.href);
    address.protocol = `ws${address.protocol.slice(4)}`;
    address.search = location.search;
    const socket = (this.socket = new WebSocket(address));
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.tries = 0;
      app.setLink("live");
    };
    socket.onmessage = ({ data }) => {
      if (typeof data === "string") return app.onNote(JSON.parse(data));
      socket.send("+"); // the server sends no more than a busy page takes in
      app.onFrame(readFrame(data));
    };
    socket.onclose = () => {
      app.setLink("lost");
      setTimeout(() => this.open(), AGAIN_MS[Math.min(this.tries++, AGAIN_MS.length - 1)]);
    };
  }

  send(command) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(command));
    return true;
  }
}

// A run that the page holds: base64 of gzip of a length, the first message as JSON, and frames; see page.py.
async function readRecording(text) {
  const packed = Uint8Array.from(atob(text), (one) => one.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const buffer = await new Response(stream).arrayBuffer();
  const size = new DataView(buffer).getUint32(0, true);
  const about = JSON.parse(decoder.decode(new Uint8Array(buffer, 4, size)));
  const frames = [];
  for (let at = 4 + size; at < buffer.byteLength; at += frames[frames.length - 1].bytes) frames.push(readFrame(buffer, at));
  return { about, frames };
}
