// Buttons and keys: both do the same things.

const KEYS = [
  ["1 2 3", "occupancy, variance, state"],
  ["F", "fit to the map"],
  ["+ −", "zoom; arrow keys move"],
  ["N", "follow the next robot"],
  ["P", "pin the middle of the screen"],
  ["L", "line with profile"],
  ["G R C", "grid, robots, clusters"],
  ["T", "dark or light"],
  ["H", "hide and show the panels"],
  ["Esc", "close, let go"],
  ["?", "this list"],
];
const ARROWS = { ArrowLeft: [-80, 0], ArrowRight: [80, 0], ArrowUp: [0, -80], ArrowDown: [0, 80] };
const TOGGLES = ["grid", "robots", "clusters"];

export function bindControls(actions) {
  const act = (name) => (TOGGLES.includes(name) ? actions.toggle(name) : actions[name]());
  for (const button of document.querySelectorAll("[data-act]")) {
    button.addEventListener("click", () => act(button.dataset.act));
  }
  const layers = [...document.querySelectorAll("[data-layer]")];
  for (const button of layers) {
    button.addEventListener("click", () => actions.layer(button.dataset.layer));
    button.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      event.stopPropagation();
      const next = layers.at((layers.indexOf(button) + step) % layers.length);
      next.focus();
      next.click();
    });
  }
  const keys = {
    1: () => actions.layer("occupancy"), 2: () => actions.layer("variance"), 3: () => actions.layer("state"),
    f: () => act("fit"), l: () => act("line"), g: () => act("grid"), r: () => act("robots"), c: () => act("clusters"),
    t: () => act("theme"), h: () => act("bare"), n: () => actions.follow(), p: () => actions.pin(), "?": () => act("help"),
    Escape: () => actions.leave(),
  };
  // Leaflet focuses the map at each click; its frame is for those who came by keyboard.
  document.addEventListener("pointerdown", () => document.body.classList.remove("by-key"), true);
  document.addEventListener("keydown", (event) => {
    document.body.classList.add("by-key");
    if (event.ctrlKey || event.altKey || event.metaKey || document.querySelector("dialog[open]")) return;
    const run = keys[event.key] ?? keys[event.key.toLowerCase()];
    if (run) {
      event.preventDefault();
      run();
    } else if (event.target === document.body) {
      // With the map in focus, Leaflet does these itself.
      if (["+", "=", "-"].includes(event.key)) act(event.key === "-" ? "zoomout" : "zoomin");
      else if (event.key in ARROWS) actions.pan(ARROWS[event.key]);
    }
  });
  const list = document.getElementById("keys");
  for (const [key, meaning] of KEYS) {
    const [term, words] = [document.createElement("dt"), document.createElement("dd")];
    term.textContent = key;
    words.textContent = meaning;
    list.append(term, words);
  }
}

/** Show on the buttons what is on. */
export function pressed(state, line) {
  for (const name of TOGGLES) set(`[data-act=${name}]`, "aria-pressed", state.show.has(name));
  set("[data-act=line]", "aria-pressed", line);
  for (const button of document.querySelectorAll("[data-layer]")) {
    const on = button.dataset.layer === state.layer;
    button.setAttribute("aria-checked", String(on));
    button.tabIndex = on ? 0 : -1;
  }
}

function set(selector, attribute, on) {
  document.querySelector(selector).setAttribute(attribute, String(on));
}
