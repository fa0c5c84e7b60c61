// The line to the server, which tells the version of the texture that is shown. Where it is lost the page says so and
// tries again, each time after a longer pause.

import { isServed } from "./data.js";

const FIRST = 1000, MOST = 60000; // milliseconds until it is tried again

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
      wait();
    });
  };

  const wait = () => {
    status.textContent = `The connection is lost; it is tried again in ${pause / 1000} s. Is octex view still running?`;
    waiting = setTimeout(retry, pause);
    pause = Math.min(2 * pause, MOST);
  };

  const retry = async () => {
    clearTimeout(waiting);
    waiting = null;
    const answer = await fetch("style.css", { cache: "no-store" }).catch(() => null);
    if (!answer) wait();
    else if (answer.ok) connect();
    else status.textContent = "octex view was started again and has another address now: open the one that it printed.";
  };

  document.addEventListener("visibilitychange", () => {
    if (waiting !== null && !document.hidden) retry();
  });
  connect();
}
