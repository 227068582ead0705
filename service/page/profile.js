// A line on the map, and the occupancy along it as a small plot.

import { paced, query } from "./api.js";
import { percent } from "./readout.js";
import { at, metres, round125 } from "./place.js";

const SAMPLES = 240;
const [LEFT, RIGHT, TOP, BOTTOM] = [34, 8, 8, 22];

export class Profile {
  #map;
  #box;
  #plot;
  #read;
  #ends = [];
  #data = null;
  #armed = false;
  #line;
  #mark;
  refresh = paced(() => this.#fetch(), 250);

  constructor(map, box) {
    this.#map = map;
    this.#box = box;
    this.#plot = box.querySelector("svg");
    this.#read = box.querySelector("#profile-read");
    this.#line = L.polyline([], {
      color: "#1f9bf0", weight: 4, dashArray: "9 6", lineCap: "butt", interactive: false,
    });
    this.#mark = L.circleMarker(at(0, 0), {
      radius: 6, color: "#fff", weight: 2, fillColor: "#56b4e9", fillOpacity: 1, interactive: false,
    });
    map.on("mousemove", ({ latlng }) => {
      if (this.#armed && this.#ends.length === 1) this.#draw([...this.#ends, [latlng.lng, latlng.lat]]);
    });
    this.#plot.addEventListener("pointermove", (event) => this.#point(event));
    this.#plot.addEventListener("pointerleave", () => this.#mark.remove());
    new ResizeObserver(() => this.#render()).observe(this.#plot);
  }

  get armed() {
    return this.#armed;
  }

  /** The two ends [[x, y], [x, y]], or null. */
  get ends() {
    return this.#ends.length === 2 ? this.#ends : null;
  }

  arm() {
    this.clear();
    this.#armed = true;
    this.#map.fire("profiled");
  }

  /** Take a click as an end of the line; tell whether it was wanted. */
  click(x, y) {
    if (!this.#armed) return false;
    this.#ends.push([x, y]);
    if (this.#ends.length === 2) this.set(this.#ends);
    else this.#draw(this.#ends);
    return true;
  }

  set(ends) {
    this.#armed = false;
    this.#ends = ends;
    this.#draw(ends);
    this.#box.hidden = false;
    document.body.classList.add("profiling");
    this.refresh();
    this.#map.fire("profiled");
  }

  clear() {
    this.#armed = false;
    this.#ends = [];
    this.#data = null;
    this.#line.remove();
    this.#mark.remove();
    this.#box.hidden = true;
    document.body.classList.remove("profiling");
    this.#map.fire("profiled");
  }

  #draw(ends) {
    this.#line.setLatLngs(ends.map(([x, y]) => at(x, y))).addTo(this.#map);
  }

  async #fetch() {
    if (!this.ends) return;
    const [[x0, y0], [x1, y1]] = this.#ends;
    const places = Array.from({ length: SAMPLES }, (_, i) => {
      const t = i / (SAMPLES - 1);
      return [x0 + t * (x1 - x0), y0 + t * (y1 - y0)];
    });
    const answer = await query(places);
    this.#data = { places, answer, length: Math.hypot(x1 - x0, y1 - y0) || 1e-9 };
    this.#render();
  }

  #render() {
    if (!this.#data) return;
    const { answer, length } = this.#data;
    const { clientWidth: width, clientHeight: height } = this.#plot;
    if (!width) return;
    const x = (i) => LEFT + (i / (SAMPLES - 1)) * (width - LEFT - RIGHT);
    const y = (p) => TOP + (1 - p) * (height - TOP - BOTTOM);
    const path = answer.occupancy.map((p, i) => `${i ? "L" : "M"}${x(i).toFixed(1)} ${y(p).toFixed(1)}`);
    // The band is how far the standard deviation reaches, around the probability.
    const prior = Math.max(...answer.variance, 1e-9);
    const half = answer.variance.map((v) => 0.5 * Math.sqrt(v / Math.max(prior, 1)));
    const edge = (sign) => answer.occupancy.map((p, i) => (
      `${x(i).toFixed(1)} ${y(Math.min(1, Math.max(0, p + sign * half[i]))).toFixed(1)}`
    ));
    const band = `M${edge(1).join("L")}L${edge(-1).reverse().join("L")}Z`;
    this.#plot.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.#plot.innerHTML = [
      ...unknown(answer.known).map(([a, b]) => (
        `<rect class="unknown" x="${x(a)}" y="${TOP}" width="${Math.max(1, x(b) - x(a))}" height="${y(0) - TOP}"/>`
      )),
      `<path class="band" d="${band}"/>`,
      `<line class="half" x1="${LEFT}" x2="${width - RIGHT}" y1="${y(0.5)}" y2="${y(0.5)}"/>`,
      `<line class="axis" x1="${LEFT}" x2="${width - RIGHT}" y1="${y(0)}" y2="${y(0)}"/>`,
      ...[0, 0.5, 1].map((p) => `<text x="${LEFT - 6}" y="${y(p) + 4}" text-anchor="end">${p}</text>`),
      ...ticks(length, width).map((m) => (
        `<text x="${LEFT + (m / length) * (width - LEFT - RIGHT)}" y="${height - 5}" text-anchor="middle">${metres(m, 0.1).replace(/\.0$/, "")} m</text>`
      )),
      `<path class="line" d="${path.join("")}"/>`,
      `<line class="at" y1="${TOP}" y2="${y(0)}" visibility="hidden"/>`,
    ].join("");
    this.#read.textContent = `${metres(length)} m · probability, band: standard deviation`;
  }

  #point(event) {
    if (!this.#data) return;
    const { answer, places, length } = this.#data;
    const box = this.#plot.getBoundingClientRect();
    const t = (event.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT);
    const i = Math.round(Math.min(1, Math.max(0, t)) * (SAMPLES - 1));
    const at_ = LEFT + (i / (SAMPLES - 1)) * (box.width - LEFT - RIGHT);
    const cursor = this.#plot.querySelector(".at");
    for (const name of ["x1", "x2"]) cursor.setAttribute(name, at_);
    cursor.setAttribute("visibility", "visible");
    const [x, y] = places[i];
    this.#mark.setLatLng(at(x, y)).addTo(this.#map);
    const value = answer.known[i] ? percent(answer.occupancy[i]) : "unknown";
    this.#read.textContent =
      `${metres((i / (SAMPLES - 1)) * length)} m · ${value} · variance ${answer.variance[i].toFixed(3)}`;
  }
}

function unknown(known) {
  const spans = [];
  known.forEach((is, i) => {
    if (is) return;
    if (spans.length && spans.at(-1)[1] === i) spans.at(-1)[1] = Math.min(i + 1, SAMPLES - 1);
    else spans.push([i, Math.min(i + 1, SAMPLES - 1)]);
  });
  return spans;
}

function ticks(length, width) {
  const step = round125((length * 60) / width);
  return Array.from({ length: Math.floor(length / step) + 1 }, (_, i) => i * step);
}
