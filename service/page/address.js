// What is seen, in the address after #, so that it can be shared: place, zoom, layer and the rest.

const FAR_M = 1e8; // metres count exactly up to there, and no site is farther

const numbers = (text, count) => {
  const values = (text ?? "").split(",").map(Number);
  return values.length === count && values.every((value) => Math.abs(value) <= FAR_M) && text ? values : null;
};

export function readAddress() {
  const words = new URLSearchParams(location.hash.slice(1));
  const view = numbers(words.get("view"), 3);
  const line = numbers(words.get("line"), 4);
  return {
    view: view && { x: view[0], y: view[1], zoom: Math.round(view[2]) },
    layer: words.get("layer"),
    theme: words.get("theme"),
    show: words.get("show")?.split(",") ?? null,
    follow: words.get("follow"),
    bare: words.has("bare"),
    pin: numbers(words.get("pin"), 2),
    line: line && [[line[0], line[1]], [line[2], line[3]]],
  };
}

export function writeAddress(state) {
  const words = new URLSearchParams();
  const place = (values) => values.flat().map((value) => Number(value.toFixed(3))).join(",");
  words.set("view", `${place([state.view.x, state.view.y])},${state.view.zoom}`);
  words.set("layer", state.layer);
  words.set("show", state.show.join(","));
  if (state.theme) words.set("theme", state.theme);
  if (state.follow) words.set("follow", state.follow);
  if (state.bare) words.set("bare", "1");
  if (state.pin) words.set("pin", place(state.pin));
  if (state.line) words.set("line", place(state.line));
  history.replaceState(null, "", `#${words.toString().replaceAll("%2C", ",")}`);
}
