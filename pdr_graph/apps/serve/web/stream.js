// The connection to the server: requests and the stream of events. The token of another machine's page is in a cookie.

const RETRY = 2000; // [ms]

export const address = (path) => new URL(path, document.baseURI).href;

// The JSON at a path; raises an Error that has the status.
export const fetched = async (path) => {
  const answer = await fetch(address(path), { cache: "no-store" });
  if (!answer.ok) throw Object.assign(new Error(`${path}: ${answer.status}`), { status: answer.status });
  return answer.json();
};

// Listen to events while the page is visible: a browser has six connections to a server at most, for all its tabs, and a
// page that is shown again is sent everything. handlers: function of the data of each event; connected: called with true
// or false.
export const listen = (handlers, connected) => {
  let source = null,
    timer;
  const open = () => {
    if (source) return;
    source = new EventSource(address("events"));
    source.addEventListener("open", () => connected(true));
    source.addEventListener("error", (event) => {
      connected(false);
      if (event.target.readyState !== EventSource.CLOSED) return; // the browser tries again
      close();
      timer = setTimeout(open, RETRY);
    });
    for (const [name, act] of Object.entries(handlers)) source.addEventListener(name, (event) => act(JSON.parse(event.data)));
  };
  const close = () => {
    clearTimeout(timer);
    if (source) source.close();
    source = null;
  };
  addEventListener("pagehide", close);
  addEventListener("pageshow", open);
  document.addEventListener("visibilitychange", () => (document.hidden ? close() : open()));
  open();
};
