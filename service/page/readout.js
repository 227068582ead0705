// What the map says under the pointer, and at the pin.

import { paced, query } from "./api.js";
import { at, metres } from "./place.js";

const PAUSE_MS = 40;

export function describe(answer, index = 0) {
  const p = answer.occupancy[index];
  const variance = answer.variance[index];
  const known = answer.known[index];
  const state = !known ? "unknown" : p > 0.5 ? "occupied" : "free";
  return { p, variance, known, state };
}

export const percent = (p) => (
  p > 0.0005 && p < 0.9995 ? `${(p * 100).toFixed(1)} %` : p <= 0.0005 ? "< 0.1 %" : "> 99.9 %"
);

export class Readout {
  #map;
  #place;
  #value;
  #pin = null;
  #last = null;
  #ask = paced((x, y) => this.#read(x, y), PAUSE_MS);
  #askPin = paced(() => this.#readPin(), 250);

  constructor(map, place, value) {
    this.#map = map;
    this.#place = place;
    this.#value = value;
    map.on("mousemove", ({ latlng }) => this.look(latlng.lng, latlng.lat));
  }

  /** Read the map at a place, in metres. */
  look(x, y) {
    this.#last = [x, y];
    const step = 2 ** -this.#map.getZoom();
    this.#place.textContent = `x ${metres(x, step)} m   y ${metres(y, step)} m`;
    this.#ask(x, y);
  }

  /** Read again what is on show, since the map changed. */
  refresh() {
    if (this.#last) this.#ask(...this.#last);
    if (this.#pin) this.#askPin();
  }

  get last() {
    return this.#last;
  }

  get pinned() {
    return this.#pin ? [this.#pin.x, this.#pin.y] : null;
  }

  /** Put the pin; null takes it away. */
  pin(place) {
    this.#pin?.marker.remove();
    this.#pin = null;
    if (place) {
      const [x, y] = place;
      const icon = L.divIcon({
        className: "pin",
        html: '<svg width="18" height="18" viewBox="-9 -9 18 18"><circle r="6"/></svg>',
        iconSize: [18, 18],
      });
      const marker = L.marker(at(x, y), { icon, keyboard: false, alt: "pin" })
        .bindTooltip("…", { permanent: true, direction: "right", offset: [10, 0] })
        .on("click", (event) => {
          L.DomEvent.stopPropagation(event);
          this.pin(null);
          this.#map.fire("pinned");
        })
        .addTo(this.#map);
      this.#pin = { x, y, marker };
      this.#askPin();
      if (!this.#last) this.look(x, y);
    }
    this.#map.fire("pinned");
  }

  async #read(x, y) {
    const { p, variance, state } = describe(await query([[x, y]]));
    this.#value.innerHTML = `<b></b> <span></span>`;
    this.#value.firstChild.textContent = state === "unknown" ? "unknown" : `${state} ${percent(p)}`;
    const [, words] = this.#value.children;
    words.textContent = `p ${p.toFixed(3)}   variance ${variance.toFixed(3)}`;
    words.className = "muted mono";
    Object.assign(this.#value.dataset, { p, variance, x, y });
  }

  async #readPin() {
    const pin = this.#pin;
    if (!pin) return;
    const { p, variance, state } = describe(await query([[pin.x, pin.y]]));
    const words = state === "unknown" ? "unknown" : `p ${p.toFixed(3)} · ${state}`;
    pin.marker.setTooltipContent(
      `${words}<br>variance ${variance.toFixed(3)}<br>` +
      `${metres(pin.x)}, ${metres(pin.y)} m`,
    );
  }
}
