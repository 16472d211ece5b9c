// The page's socket without a page: one that reads everything, and one that reads nothing.

const { randomBytes } = require("node:crypto");
const { connect } = require("node:net");

/** Opened as a browser of this host would. */
function opened(url) {
  const { hostname, port, host } = new URL(url);
  const socket = connect(Number(port), hostname);
  socket.write([
    "GET /socket HTTP/1.1", `Host: ${host}`, `Origin: http://${host}`, "Upgrade: websocket", "Connection: Upgrade",
    "Sec-WebSocket-Version: 13", `Sec-WebSocket-Key: ${randomBytes(16).toString("base64")}`, "", "",
  ].join("\r\n"));
  socket.on("error", () => {});
  return socket;
}

/** Text of fewer than 126 bytes, masked with zeros. */
function said(command) {
  const text = Buffer.from(JSON.stringify(command));
  return Buffer.concat([Buffer.from([0x81, 0x80 | text.length, 0, 0, 0, 0]), text]);
}

/** Is there, says so, and takes nothing of what it is told. */
function stalled(url) {
  const socket = opened(url);
  socket.once("data", () => socket.pause());
  const here = setInterval(() => socket.write(said({ do: "alive" })), 2000);
  socket.on("close", () => clearInterval(here));
  return socket;
}

/** Every snapshot that the daemon sends, as long as it is open. */
class Reader {
  constructor(url) {
    this.socket = opened(url);
    this.reports = [];
    let left = Buffer.alloc(0);
    let body = false;
    this.socket.on("data", (data) => {
      left = Buffer.concat([left, data]);
      if (!body) {
        const head = left.indexOf("\r\n\r\n");
        if (head < 0) return;
        [left, body] = [left.subarray(head + 4), true];
      }
      for (let frame; (frame = taken(left)); left = frame.rest) if (frame.kind === 1) this.take(JSON.parse(frame.text));
    });
    this.here = setInterval(() => this.socket.write(said({ do: "alive" })), 2000);
  }

  take({ now }) {
    if (!now?.arm || now.arm.t === this.reports.at(-1)?.t) return;
    this.reports.push({ t: now.arm.t, state: now.robot?.state });
  }

  /** Reports a second, by the robot's own times, of the arm while it followed since this was asked last. */
  rate() {
    const seen = this.reports.splice(0);
    const apart = seen.slice(1).map((b, i) => (b.state === "Engaged" && seen[i].state === "Engaged" ? b.t - seen[i].t : 0)).filter((ms) => ms > 0);
    return (1000 * apart.length) / apart.reduce((sum, ms) => sum + ms, 0);
  }

  close() {
    clearInterval(this.here);
    this.socket.destroy();
  }
}

/** The first frame of `data`, if all of it is there. */
function taken(data) {
  if (data.length < 2) return null;
  const short = data[1] & 0x7f;
  const at = short === 126 ? 4 : short === 127 ? 10 : 2;
  if (data.length < at) return null;
  const length = short === 126 ? data.readUInt16BE(2) : short === 127 ? Number(data.readBigUInt64BE(2)) : short;
  if (data.length < at + length) return null;
  return { kind: data[0] & 0x0f, text: data.subarray(at, at + length).toString(), rest: data.subarray(at + length) };
}

module.exports = { Reader, stalled };
