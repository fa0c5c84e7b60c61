// The event stream of the server, which announces versions of the texture. If it breaks, the page says so and connects
// again: after pauses that double, and when the user comes back to the page.

import { isServed } from "./data.js";

const FIRST_PAUSE = 1000, MAX_PAUSE = 15000; // milliseconds before the next attempt

// Check that the server knows the page's token. The token is not sent: another program may have the port by now.
async function isSameServer() {
  const challenge = crypto.randomUUID(), token = location.pathname.split("/")[1], bytes = (text) => new TextEncoder().encode(text);
  const response = await fetch(`/proof?${challenge}`, { cache: "no-store" });
  const key = await crypto.subtle.importKey("raw", bytes(token), { name: "HMAC", hash: "SHA-256" }, false, ["sign"]);
  const proof = new Uint8Array(await crypto.subtle.sign("HMAC", key, bytes(challenge)));
  return (await response.text()) === Array.from(proof, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

// Call `update` with each version that the server announces, and write the state of the connection into `status`.
export function watch(status, update) {
  if (!isServed) return;
  let pause = FIRST_PAUSE, timer = null;

  const connect = () => {
    const events = new EventSource("events");
    events.addEventListener("version", (event) => {
      pause = FIRST_PAUSE;
      status.textContent = "";
      update(event.data);
    });
    events.addEventListener("changing", (event) => (status.textContent = event.data));
    events.addEventListener("error", () => {
      events.close(); // the browser itself would retry without pauses
      retryLater("Is octex view still running?");
    });
  };

  const retryLater = (why) => {
    status.textContent = `Connection lost; next attempt in ${pause / 1000} s. ${why}`;
    timer = setTimeout(retry, pause);
    pause = Math.min(2 * pause, MAX_PAUSE);
  };

  const retry = async () => {
    clearTimeout(timer);
    timer = null;
    const isSame = await isSameServer().catch(() => null);
    if (isSame) connect();
    else retryLater(isSame === null ? "Is octex view still running?" : "Another program has its port: octex view prints its new address.");
  };

  const retryNow = () => {
    if (timer !== null && !document.hidden) retry();
  };
  document.addEventListener("visibilitychange", retryNow);
  window.addEventListener("focus", retryNow);
  connect();
}
