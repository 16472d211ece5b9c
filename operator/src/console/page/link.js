// The connection to the operator daemon: the newest of what it says, and commands to it.

const AGAIN_MS = 1000;

/** More than this unsent means that nobody reads: the page then says nothing but what must be said. */
const MOST_UNSENT = 16_384;

export class Link extends EventTarget {
  constructor() {
    super();
    this.arm = null;
    this.now = null;
    this.open = false;
    this.connect();
  }

  connect() {
    const url = new URL("socket", location.href);
    url.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    url.hash = "";
    const socket = new WebSocket(url);
    this.socket = socket;
    socket.addEventListener("open", () => this.change(true));
    socket.addEventListener("close", (event) => {
      this.change(false, event.reason);
      setTimeout(() => this.connect(), AGAIN_MS);
    });
    socket.addEventListener("message", (event) => this.take(JSON.parse(event.data)));
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

  /** Says `command`; false if it could not be said. */
  say(command, urgent = true) {
    const { socket } = this;
    if (socket.readyState !== WebSocket.OPEN || (!urgent && socket.bufferedAmount > MOST_UNSENT)) return false;
    socket.send(JSON.stringify(command));
    return true;
  }
}
