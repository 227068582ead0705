// Clusters: the tracked lines, each the spine of one expert. Dirty ones have news to learn.

import { getJson, paced } from "./api.js";
import { at } from "./place.js";

const PAUSE_MS = 1500;
const GOLDEN_DEG = 137.5; // neighbours in number get hues far apart

export class Clusters {
  #map;
  #layer = L.layerGroup();
  #renderer = L.canvas({ padding: 0.3, tolerance: 6 });
  #lines = new Map();
  #visible = false;
  refresh = paced(() => this.#fetch(), PAUSE_MS);

  constructor(map) {
    this.#map = map;
  }

  show(visible) {
    this.#visible = visible;
    if (visible) {
      this.#layer.addTo(this.#map);
      this.refresh();
    } else {
      this.#layer.remove();
    }
  }

  async #fetch() {
    if (!this.#visible) return;
    const { experts } = await getJson("v1/experts");
    const seen = new Set();
    for (const expert of experts) {
      seen.add(expert.cluster_id);
      this.#draw(expert);
    }
    for (const [id, line] of this.#lines) {
      if (!seen.has(id)) {
        line.remove();
        this.#lines.delete(id);
      }
    }
  }

  #draw(expert) {
    const { cluster_id: id, line: ends, dirty } = expert;
    const style = {
      color: `hsl(${(id * GOLDEN_DEG) % 360} 75% 58%)`,
      weight: dirty ? 6 : 4,
      opacity: 0.95,
      dashArray: dirty ? "3 7" : null,
    };
    const places = ends.map(([x, y]) => at(x, y));
    let line = this.#lines.get(id);
    if (line) {
      line.setLatLngs(places).setStyle(style);
    } else {
      line = L.polyline(places, { ...style, renderer: this.#renderer });
      line.bindTooltip("", { sticky: true, direction: "top" }).addTo(this.#layer);
      this.#lines.set(id, line);
    }
    line.setTooltipContent(
      `cluster ${id}${dirty ? " · waits for training" : ""}<br>${expert.hits} hits, ` +
      `${expert.observations} observations<br>length scale ${expert.length_scale_m.toFixed(2)} m`,
    );
  }
}
