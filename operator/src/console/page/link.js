// The connection to the operator daemon: the newest of what it says, and commands to it.

const AGAIN_MS = 1000;

/** Snapshots of a robot that is linked come every 25 ms; none for so many looks is a connection that is dead. */
const LOOK_MS = 250;
const MOST_QUIET = 4;

/** The same of one that is not open yet, or has said nothing yet. */
const MOST_MUTE = 20;

/** More than this unsent means that nobody reads: the page then says nothing but what must be said. */
const MOST_UNSENT = 16_384;

export class Link extends EventTarget {
  constructor() {
    super();
    this.arm = null;
    this.now = null;
    this.open = false;
    this.connect();
    setInterval(() => this.look(), LOOK_MS);
  }

  connect() {
    const url = new URL("socket", location.href);
    url.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    url.hash = "";
    const socket = new WebSocket(url);
    this.socket = socket;
    this.quiet = 0;
    const ours = (does) => (event) => socket === this.socket && does(event);
    socket.addEventListener("open", ours(() => this.change(true)));
    socket.addEventListener("close", ours((event) => this.ends(event.reason)));
    socket.addEventListener("message", ours((event) => {
      this.quiet = 0;
      this.take(JSON.parse(event.data));
    }));
  }

  /** A dead connection's own close may come minutes later: it is not waited for. */
  ends(why) {
    this.socket.close();
    this.socket = null;
    this.change(false, why);
    setTimeout(() => this.connect(), AGAIN_MS);
  }

  /** Counts looks and not time: a page that hung, or sleeps, has its messages before it looks again. */
  look() {
    if (!this.socket || (this.now && !this.now.linked)) return;
    this.quiet += 1;
    if (this.quiet > (this.now ? MOST_QUIET : MOST_MUTE)) this.ends("nothing comes from the operator daemon");
  }

  change(open, why = "") {
    this.open = open;
    this.now = null;
    this.dispatchEvent(new CustomEvent("link", { detail: { open, why } }));
  }

  take(message) {
    if (message.arm !== undefined) this.arm = message.arm;
    if (message.now) {
      this.now = message.now;
      this.dispatchEvent(new CustomEvent("now", { detail: message.now }));
    }
  }

  /** Says `command`; false if it could not be said. What was said may still be lost with the connection. */
  say(command, urgent = true) {
    const { socket } = this;
    if (socket?.readyState !== WebSocket.OPEN || (!urgent && socket.bufferedAmount > MOST_UNSENT)) return false;
    socket.send(JSON.stringify(command));
    return true;
  }
}
