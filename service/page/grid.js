// The metric grid with its labels, and the scale bar.

import { lengthText, metres, round125 } from "./place.js";

const LEAST_PX = 70;

export class Grid {
  #map;
  #canvas;
  #bar;
  #visible = true;

  constructor(map, canvas, bar) {
    this.#map = map;
    this.#canvas = canvas;
    this.#bar = bar;
    map.on("move zoom viewreset resize", () => this.draw());
    map.on("zoomanim", ({ center, zoom }) => this.#paint(center, zoom));
    window.addEventListener("resize", () => this.draw());
  }

  show(visible) {
    this.#visible = visible;
    this.draw();
  }

  draw() {
    this.#paint(this.#map.getCenter(), this.#map.getZoom());
    const pixels = 2 ** this.#map.getZoom();
    const step = round125(48 / pixels);
    this.#bar.firstElementChild.style.width = `${step * pixels}px`;
    this.#bar.lastElementChild.textContent = lengthText(step);
  }

  #paint(center, zoom) {
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = this.#canvas;
    this.#canvas.width = width * ratio;
    this.#canvas.height = height * ratio;
    const pen = this.#canvas.getContext("2d");
    if (!this.#visible) return;
    const style = getComputedStyle(document.documentElement);
    const color = (name) => style.getPropertyValue(name);
    pen.scale(ratio, ratio);
    pen.font = "11px system-ui, sans-serif";
    const scale = 2 ** zoom;
    const step = round125(LEAST_PX / scale);
    const left = center.lng - width / 2 / scale;
    const top = center.lat + height / 2 / scale;
    const labels = [];
    const line = (index, px, upright) => {
      pen.strokeStyle = color(index === 0 ? "--grid-strong" : index % 5 ? "--grid" : "--grid-strong");
      pen.beginPath();
      const p = Math.round(px) + 0.5;
      if (upright) { pen.moveTo(p, 0); pen.lineTo(p, height); }
      else { pen.moveTo(0, p); pen.lineTo(width, p); }
      pen.stroke();
      const [x, y] = upright ? [p + 3, height - 3] : [3, p - 3];
      if (upright ? x > 40 : y < height - 18) labels.push([metres(index * step, step), x, y]);
    };
    for (let i = Math.ceil(left / step); (i * step - left) * scale < width; i += 1) {
      line(i, (i * step - left) * scale, true);
    }
    for (let i = Math.floor(top / step); (top - i * step) * scale < height; i -= 1) {
      line(i, (top - i * step) * scale, false);
    }
    // Readable on walls too, whatever their colour.
    pen.fillStyle = color("--grid-text");
    pen.strokeStyle = color("--halo");
    pen.lineWidth = 3;
    pen.lineJoin = "round";
    for (const label of labels) {
      pen.strokeText(...label);
      pen.fillText(...label);
    }
  }
}
