// The line to the server: said where it is lost, mended by itself, and the page read anew when the texture changes.

export function watch(status) {
  if (document.getElementById("data-header")) return; // the page is a file
  let version = null;
  const events = new EventSource("events");
  events.addEventListener("version", (event) => {
    status.textContent = "";
    if (version !== null && version !== event.data) location.reload();
    version = event.data;
  });
  events.addEventListener("changing", (event) => (status.textContent = event.data));
  events.addEventListener("error", () => {
    status.textContent = "The connection is lost; it is tried again. Is octex view still running?";
  });
}
