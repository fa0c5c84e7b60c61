// The line to the server, which tells the version of the texture that is shown. Where it is lost the page says so and
// tries again, each time after a longer pause, and when somebody comes back to the page.

import { isServed } from "./data.js";

const FIRST = 1000, MOST = 15000; // milliseconds until it is tried again

// Whether the server has the page's token. It is not sent: another program may have the port by now.
async function isOurs() {
  const asked = crypto.randomUUID(), token = location.pathname.split("/")[1], bytes = (text) => new TextEncoder().encode(text);
  const answer = await fetch(`/proof?${asked}`, { cache: "no-store" });
  const key = await crypto.subtle.importKey("raw", bytes(token), { name: "HMAC", hash: "SHA-256" }, false, ["sign"]);
  const proof = new Uint8Array(await crypto.subtle.sign("HMAC", key, bytes(asked)));
  return (await answer.text()) === Array.from(proof, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

export function watch(status, follow) {
  if (!isServed) return;
  let pause = FIRST, waiting = null;

  const connect = () => {
    const events = new EventSource("events");
    events.addEventListener("version", (event) => {
      pause = FIRST;
      status.textContent = "";
      follow(event.data);
    });
    events.addEventListener("changing", (event) => (status.textContent = event.data));
    events.addEventListener("error", () => {
      events.close(); // browsers would try again all the time
      wait("Is octex view still running?");
    });
  };

  const wait = (why) => {
    status.textContent = `The connection is lost; it is tried again in ${pause / 1000} s. ${why}`;
    waiting = setTimeout(retry, pause);
    pause = Math.min(2 * pause, MOST);
  };

  const retry = async () => {
    clearTimeout(waiting);
    waiting = null;
    const isBack = await isOurs().catch(() => null);
    if (isBack) connect();
    else wait(isBack === null ? "Is octex view still running?" : "Another program has its port: octex view prints its new address.");
  };

  const look = () => {
    if (waiting !== null && !document.hidden) retry();
  };
  document.addEventListener("visibilitychange", look);
  window.addEventListener("focus", look);
  connect();
}
