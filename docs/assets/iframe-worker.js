// Browsers start no worker from a file: there the search runs in a hidden frame, so that the site needs no server.
class FrameWorker {
  constructor(url) {
    this.frame = document.createElement("iframe");
    this.frame.hidden = true;
    document.documentElement.append(this.frame);
    const inside = this.frame.contentWindow;
    inside.postMessage = (data) => this.onmessage?.({ data });
    const script = inside.document.createElement("script");
    script.src = new URL(url, location);
    this.ready = new Promise((resolve) => (script.onload = resolve));
    inside.document.body.append(script);
  }
  postMessage(data) {
    this.ready.then(() => this.frame.contentWindow.onmessage?.({ data }));
  }
  terminate() {
    this.frame.remove();
  }
}
if (location.protocol === "file:") window.Worker = FrameWorker;
