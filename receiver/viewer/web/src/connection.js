// The WebSocket to the receiver: acknowledges what it took in, and dials again when the connection is lost.

import { decodeMessage, VERSION } from "./messages.js";

const FIRST_PAUSE_MS = 250;
const LONGEST_PAUSE_MS = 4000;

/**
 * Calls `handlers[kind](message)` for each message, `handlers.closed()` whenever the receiver is out of reach, and
 * `handlers.outdated()`, then nothing more, where it speaks another version. `send(text)` of what it returns says
 * something to the receiver, if it is there.
 */
export function connect(handlers) {
  const url = new URL("ws", location.href);
  url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
  let pauseMs = FIRST_PAUSE_MS;
  let socket = null;

  function dial() {
    socket = new WebSocket(url);
    socket.binaryType = "arraybuffer";
    let takenIn = 0;
    socket.onmessage = ({ data, target }) => {
      pauseMs = FIRST_PAUSE_MS;
      const message = decodeMessage(data);
      if (message.kind === "hello" && message.version !== VERSION) {
        socket.onclose = socket.onmessage = null;
        socket.close();
        return handlers.outdated();
      }
      handlers[message.kind](message);
      if (typeof data !== "string") target.send(new Uint32Array([++takenIn]));
    };
    socket.onclose = () => {
      handlers.closed();
      setTimeout(dial, pauseMs * (0.75 + 0.5 * Math.random()));
      pauseMs = Math.min(2 * pauseMs, LONGEST_PAUSE_MS);
    };
  }
  dial();
  return {
    send(text) {
      if (socket.readyState === WebSocket.OPEN) socket.send(text);
    },
  };
}
