// Robots: where they are, where they look, where they came from, and how fresh that is.

import { at } from "./place.js";

const COLORS = ["#56b4e9", "#cc79a7", "#2fbf93", "#e69f00", "#8a7ff0", "#d55e00", "#b7c441"];
const TRAIL_POINTS = 1500;
const TRAIL_STEP_M = 0.05;
const STALE_S = 3;

export class Robots extends EventTarget {
  #robots = new Map();
  #clockOffsetS = 0;
  #layer = L.layerGroup();
  #trails = L.canvas({ padding: 0.3 });
  #map;

  constructor(map) {
    super();
    this.#map = map;
    map.on("zoomstart", () => this.#glide(false));
    map.on("zoomend", () => requestAnimationFrame(() => this.#glide(true)));
    setInterval(() => this.#age(), 1000);
  }

  show(visible) {
    if (visible) this.#layer.addTo(this.#map);
    else this.#layer.remove();
  }

  /** Take a `poses` event. */
  take({ time, robots }) {
    this.#clockOffsetS = time - Date.now() / 1000;
    for (const news of robots) this.#update(news);
    this.#age();
  }

  pose(id) {
    return this.#robots.get(id)?.news.pose ?? null;
  }

  get ids() {
    return [...this.#robots.keys()];
  }

  /** [{id, color, fresh, text}], by name. */
  summary() {
    return [...this.#robots.values()].map(({ news, color, fresh, text }) => (
      { id: news.id, color, fresh, text }
    )).sort((a, b) => a.id.localeCompare(b.id, undefined, { numeric: true }));
  }

  #update(news) {
    let robot = this.#robots.get(news.id);
    if (!robot) {
      robot = { color: COLORS[this.#robots.size % COLORS.length], fresh: "", text: "", marker: null };
      this.#robots.set(news.id, robot);
    }
    robot.news = news;
    if (!news.pose) return;
    const [x, y, yaw] = news.pose;
    if (!robot.marker) this.#appear(robot, x, y);
    robot.marker.setLatLng(at(x, y));
    const trail = robot.trail.getLatLngs();
    const last = trail.at(-1);
    if (!last || Math.hypot(last.lng - x, last.lat - y) > TRAIL_STEP_M) {
      trail.push(at(x, y));
      if (trail.length > TRAIL_POINTS) trail.splice(0, trail.length - TRAIL_POINTS);
      robot.trail.setLatLngs(trail);
    }
    const shape = robot.marker.getElement()?.querySelector("g");
    shape?.setAttribute("transform", `rotate(${(-yaw * 180) / Math.PI})`);
    robot.yaw = yaw;
  }

  #appear(robot, x, y) {
    const body = document.createElement("div");
    body.innerHTML = `<svg width="26" height="26" viewBox="-13 -13 26 26" aria-hidden="true">
      <g><path class="body" d="M11 0 L-8 8 L-4 0 L-8 -8 Z"/></g></svg><span></span>`;
    body.querySelector("span").textContent = robot.news.id;
    const icon = L.divIcon({ className: "robot glide", html: body, iconSize: [26, 26] });
    robot.trail = L.polyline([], {
      color: robot.color, weight: 2.5, opacity: 0.75, renderer: this.#trails, interactive: false,
    }).addTo(this.#layer);
    robot.marker = L.marker(at(x, y), { icon, keyboard: false, title: robot.news.id })
      .on("click", () => this.dispatchEvent(new CustomEvent("pick", { detail: robot.news.id })))
      .on("add", () => this.#paint(robot))
      .addTo(this.#layer);
    this.#paint(robot);
  }

  #paint(robot) {
    const element = robot.marker?.getElement();
    if (!element) return;
    element.style.setProperty("--robot", robot.color);
    element.dataset.fresh = robot.fresh;
    element.dataset.robot = robot.news.id;
    const turn = (-(robot.yaw ?? robot.news.pose[2]) * 180) / Math.PI;
    element.querySelector("g").setAttribute("transform", `rotate(${turn})`);
    const late = robot.fresh === "live" ? "" : ` · ${robot.text}`;
    element.querySelector("span").textContent = robot.news.id + late;
  }

  #age() {
    const now = Date.now() / 1000 + this.#clockOffsetS;
    for (const robot of this.#robots.values()) {
      const { last_seen: seen, alive } = robot.news;
      const age = seen === null ? Infinity : Math.max(0, now - seen);
      const fresh = age < STALE_S ? "live" : alive ? "stale" : "gone";
      const text = fresh === "live" ? "live" : ageText(age);
      if (fresh !== robot.fresh || text !== robot.text) {
        Object.assign(robot, { fresh, text });
        this.#paint(robot);
      }
    }
    this.dispatchEvent(new Event("change"));
  }

  #glide(on) {
    for (const { marker } of this.#robots.values()) {
      marker?.getElement()?.classList.toggle("glide", on);
    }
  }
}

function ageText(s) {
  if (!Number.isFinite(s)) return "no scan";
  if (s < 90) return `${Math.round(s)} s ago`;
  return s < 5400 ? `${Math.round(s / 60)} min ago` : `${Math.round(s / 3600)} h ago`;
}
