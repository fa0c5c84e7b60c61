// The line to the server: said where it is lost, mended by itself; it tells which version of the texture is shown.

const RETRY = 3000; // milliseconds until it is tried again, where the browser does not by itself

export function watch(status, follow) {
  if (document.getElementById("data-header")) return; // the page is a file
  const connect = () => {
    const events = new EventSource("events");
    events.addEventListener("version", (event) => {
      status.textContent = "";
      follow(event.data);
    });
    events.addEventListener("changing", (event) => (status.textContent = event.data));
    events.addEventListener("error", () => {
      status.textContent = "The connection is lost; it is tried again. Is octex view still running?";
      if (events.readyState === EventSource.CLOSED) setTimeout(connect, RETRY);
    });
  };
  connect();
}
