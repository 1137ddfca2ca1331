// SPDX-License-Identifier: MIT
// Search for a site that is opened from a folder. Browsers start no worker for a page of file://, so the script of
// the search runs in a hidden frame of the page instead. `search.offline` of mkdocs-material expects this name.
if (location.protocol === "file:") {
  class FrameWorker extends EventTarget {
    constructor(address) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.body.append(this.frame);
      this.scope = this.frame.contentWindow;
      const page = this.scope.document;
      page.open(); // otherwise Firefox replaces the empty page, and the script with it
      page.write("<!doctype html><body>");
      page.close();
      this.scope.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      const script = page.createElement("script");
      this.loaded = new Promise((resolve) => (script.onload = resolve));
      script.src = new URL(address, location.href);
      page.body.append(script);
    }

    postMessage(data) {
      this.loaded.then(() => this.scope.dispatchEvent(new MessageEvent("message", { data })));
    }

    terminate() {
      this.frame.remove();
    }
  }
  window.Worker = window.IFrameWorker = FrameWorker;
}
