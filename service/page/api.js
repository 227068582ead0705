// The service: questions over HTTP, news by server-sent events. Addresses are relative, so that
// the page also works behind a proxy that gives it a folder of its own.

const SILENCE_MS = 7000; // the service says something at least every 2 s
const RETRY_MS = 1500;

export async function getJson(path, options = {}) {
  const answer = await fetch(path, { headers: { Accept: "application/json" }, ...options });
  if (!answer.ok) throw new Error(`${path}: ${answer.status}`);
  return answer.json();
}

/** Occupancy, mean, variance and known at points [[x, y], …] in metres. */
export function query(points, signal) {
  return getJson("v1/query", {
    method: "POST",
    headers: { "Content-Type": "application/json", Accept: "application/json" },
    body: JSON.stringify({ points }),
    signal,
  });
}

/**
 * News of the service; comes back by itself after a lost connection.
 * Dispatches "map", "robot", "poses" and "health" with the data as detail, and "link" with
 * {state, why}: connecting, live, lost or refused, and what the service said to refuse.
 */
export class Feed extends EventTarget {
  #source = null;
  #heard = 0;
  #state = "";

  start() {
    this.#open();
    setInterval(() => this.#watch(), 1000);
    // A phone that wakes up has an old stream.
    document.addEventListener("visibilitychange", () => { if (!document.hidden) this.#watch(); });
  }

  #open() {
    this.#source?.close();
    this.#heard = performance.now();
    this.#tell(this.#state === "" ? "connecting" : this.#state);
    const source = new EventSource("v1/events");
    this.#source = source;
    for (const kind of ["map", "robot", "poses", "health"]) {
      source.addEventListener(kind, (event) => {
        this.#heard = performance.now();
        this.#tell("live");
        this.dispatchEvent(new CustomEvent(kind, { detail: JSON.parse(event.data) }));
      });
    }
    source.onerror = () => {
      const answered = source.readyState === EventSource.CLOSED;
      this.#tell("lost");
      source.close();
      if (answered) this.#explain();
      setTimeout(() => { if (this.#source === source) this.#open(); }, RETRY_MS);
    };
  }

  /** An answer that is no stream: find out what it says, which an EventSource does not tell. */
  async #explain() {
    const answer = await fetch("v1/status").catch(() => null);
    if (!answer || answer.ok || this.#state !== "lost") return;
    const { detail } = await answer.json().catch(() => ({}));
    if (this.#state === "lost") this.#tell("refused", detail ?? answer.statusText);
  }

  #watch() {
    if (performance.now() - this.#heard > SILENCE_MS) {
      this.#tell("lost");
      this.#open();
    }
  }

  #tell(state, why = "") {
    // Refused again is no news: it stays so until there is something else to say.
    if (state === this.#state || (state === "lost" && this.#state === "refused")) return;
    this.#state = state;
    this.dispatchEvent(new CustomEvent("link", { detail: { state, why } }));
  }
}

/** Run at most one `work` at a time and at most every `pauseMs`; the newest wish wins. */
export function paced(work, pauseMs) {
  let wish = null;
  let busy = false;
  async function run() {
    busy = true;
    while (wish) {
      const args = wish;
      wish = null;
      try { await work(...args); } catch { /* shown by the feed as a lost link */ }
      await new Promise((done) => { setTimeout(done, pauseMs); });
    }
    busy = false;
  }
  return (...args) => {
    wish = args;
    if (!busy) run();
  };
}
