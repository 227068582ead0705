// The live map: puts the parts together and keeps what is shown and the address in step.

import { readAddress, writeAddress } from "./address.js";
import { Feed, getJson, paced } from "./api.js";
import { Clusters } from "./clusters.js";
import { bindControls, pressed } from "./controls.js";
import { Grid } from "./grid.js";
import { drawLegend } from "./legend.js";
import { at, boxOf, createMap } from "./place.js";
import { Profile } from "./profile.js";
import { Readout } from "./readout.js";
import { Robots } from "./robots.js";
import { LiveTiles } from "./tiles.js";

const LAYERS = ["occupancy", "variance", "state"];
const byId = (id) => document.getElementById(id);
const wanted = readAddress();
const still = window.matchMedia("(prefers-reduced-motion: reduce)");
const dark = window.matchMedia("(prefers-color-scheme: dark)");
const [palettes, firstStatus] = [getJson("page/palettes.json"), getJson("v1/status").catch(() => null)];

const state = {
  layer: LAYERS.includes(wanted.layer) ? wanted.layer : "occupancy",
  theme: ["dark", "light"].includes(wanted.theme) ? wanted.theme : null, // null: as the system
  show: new Set(wanted.show ?? ["grid", "robots"]),
  follow: wanted.follow,
  bare: wanted.bare,
  placed: Boolean(wanted.view),
};
const theme = () => state.theme ?? (dark.matches ? "dark" : "light");

const map = createMap(byId("map"));
document.documentElement.dataset.theme = theme();
map.setView(at(wanted.view?.x ?? 0, wanted.view?.y ?? 0), wanted.view?.zoom ?? 4);
const tiles = new LiveTiles(state.layer, theme());
const grid = new Grid(map, byId("grid"), byId("scale"));
const robots = new Robots(map);
const clusters = new Clusters(map);
const readout = new Readout(map, byId("place"), byId("value"));
const profile = new Profile(map, byId("profile"));
const feed = new Feed();
let counts = null;
let troubles = [];
let refusal = "";

async function paint() {
  document.documentElement.dataset.theme = theme();
  document.body.classList.toggle("bare", state.bare);
  pressed(state, profile.armed || Boolean(profile.ends));
  grid.show(state.show.has("grid"));
  robots.show(state.show.has("robots"));
  clusters.show(state.show.has("clusters"));
  remember();
  const { [theme()]: colors, ...scale } = await palettes;
  drawLegend(byId("legend-body"), state.layer, { colors: colors[state.layer], ...scale }, state.show.has("clusters"));
}

const remember = paced(() => {
  const { lng, lat } = map.getCenter();
  writeAddress({
    ...state,
    view: { x: lng, y: lat, zoom: map.getZoom() },
    show: [...state.show],
    pin: readout.pinned,
    line: profile.ends,
  });
}, 400); // Safari allows a hundred a half minute

function fit(bounds) {
  if (!bounds) return;
  state.placed = true;
  const phone = window.innerWidth < 720;
  map.fitBounds(boxOf(bounds), {
    paddingTopLeft: phone ? [4, 60] : [20, 64],
    paddingBottomRight: phone ? [4, 150] : [110, 20],
    animate: false,
  });
}

function showStatus(status) {
  if (!status) return;
  counts = status;
  sayEmpty();
  const count = (n, one) => `${n.toLocaleString("en")} ${one}${n === 1 ? "" : "s"}`;
  const behind = status.dirty_experts ? ` · ${status.dirty_experts.toLocaleString("en")} to learn` : "";
  byId("numbers").textContent =
    `version ${status.map_version} · ${count(status.scans_integrated, "scan")} · ${count(status.experts, "expert")}${behind}`;
  if (!state.placed) fit(status.bounds);
}

/** What an empty map waits for. */
function sayEmpty() {
  byId("empty").hidden = !counts || Boolean(counts.bounds);
  if (byId("empty").hidden) return;
  const [title, words] = byId("empty").querySelectorAll("b, p");
  [title.textContent, words.textContent] = troubles.length
    ? ["The service is getting ready", "The map appears here by itself."]
    : counts.scans_received
      ? ["The first scans are here", "The map appears as soon as it is learnt."]
      : ["Waiting for the first scan", "The map draws itself as soon as a robot sends one. No robot at hand? “gpom simulate” and “gpom replay” send scans, too."];
}

/** What keeps the service from its work, or us from the service. */
function sayTrouble() {
  const words = refusal || troubles.join("; ");
  byId("trouble").hidden = !words;
  byId("trouble").textContent = words;
  sayEmpty();
}

const refreshStatus = paced(async () => showStatus(await getJson("v1/status")), 1000);

const actions = {
  zoomin: () => map.zoomIn(),
  zoomout: () => map.zoomOut(),
  fit: async () => {
    follow(null);
    fit((await getJson("v1/status").catch(() => counts))?.bounds);
  },
  line: () => {
    if (profile.armed || profile.ends) profile.clear();
    else profile.arm();
  },
  "profile-close": () => profile.clear(),
  theme: () => {
    state.theme = theme() === "dark" ? "light" : "dark";
    look();
  },
  bare: () => {
    state.bare = !state.bare;
    paint();
  },
  pan: (pixels) => map.panBy(pixels),
  more: () => {
    const open = byId("menu").classList.toggle("open");
    byId("more").setAttribute("aria-expanded", String(open));
  },
  less: () => {
    byId("menu").classList.remove("open");
    byId("more").setAttribute("aria-expanded", "false");
  },
  help: () => byId("help").showModal(),
  layer: (name) => {
    state.layer = name;
    look();
  },
  toggle: (name) => {
    if (!state.show.delete(name)) state.show.add(name);
    paint();
  },
  pin: () => {
    const { lng, lat } = map.getCenter();
    readout.look(lng, lat);
    readout.pin([lng, lat]);
  },
  follow: () => {
    const ids = robots.summary().map(({ id }) => id);
    follow([...ids, null][ids.indexOf(state.follow) + 1]);
  },
  leave: () => {
    if (profile.armed || profile.ends) profile.clear();
    else if (state.follow) follow(null);
    else readout.pin(null);
  },
};

function look() {
  tiles.look(state.layer, theme());
  paint();
}

function follow(id) {
  state.follow = id;
  move();
  listRobots();
  remember();
}

function move() {
  const pose = state.follow && robots.pose(state.follow);
  if (!pose) return;
  state.placed = true;
  // As fast as its marker glides, so that it stays where it is on the screen.
  map.panTo(at(pose[0], pose[1]), { duration: 0.16, easeLinearity: 1, ...(still.matches && { animate: false }) });
}

function listRobots() {
  const list = byId("robots");
  const rows = robots.summary();
  byId("fleet").hidden = rows.length === 0;
  while (list.children.length < rows.length) {
    const item = document.createElement("li");
    item.innerHTML = "<button><i></i><span></span><small></small></button>";
    item.firstChild.addEventListener("click", () => {
      const { id } = item.dataset;
      follow(state.follow === id ? null : id);
    });
    list.append(item);
  }
  rows.forEach(({ id, color, fresh, text }, i) => {
    const item = list.children[i];
    item.dataset.id = id;
    item.dataset.fresh = fresh;
    const [button, dot, name, age] = [item.firstChild, ...item.firstChild.children];
    dot.style.setProperty("--robot", color);
    name.textContent = id;
    age.textContent = state.follow === id ? "following" : text;
    button.setAttribute("aria-pressed", String(state.follow === id));
    button.title = `Follow ${id}`;
  });
}

feed.addEventListener("map", ({ detail }) => {
  if (detail.changed) tiles.changed(boxOf(detail.changed));
  refreshStatus();
  readout.refresh();
  profile.refresh();
  if (state.show.has("clusters")) clusters.refresh();
});
feed.addEventListener("poses", ({ detail }) => {
  robots.take(detail);
  move();
});
feed.addEventListener("robot", () => refreshStatus());
feed.addEventListener("health", ({ detail }) => {
  ({ troubles } = detail);
  sayTrouble();
});
feed.addEventListener("link", ({ detail: { state: link, why } }) => {
  const words = { connecting: "connecting …", live: "live", lost: "connection lost", refused: "no access" };
  const chip = byId("link");
  // Whatever answers now may have another map.
  if (link === "live" && chip.dataset.state !== "connecting") tiles.changed(null);
  chip.textContent = words[link];
  chip.dataset.state = link;
  refusal = why;
  sayTrouble();
});
robots.addEventListener("change", listRobots);
robots.addEventListener("pick", ({ detail }) => follow(detail));
dark.addEventListener("change", look);
map.on("moveend zoomend pinned", remember);
map.on("profiled", () => {
  pressed(state, profile.armed || Boolean(profile.ends));
  remember();
});
map.on("dragstart", () => { if (state.follow) follow(null); });
map.on("click", ({ latlng: { lng, lat } }) => {
  if (profile.click(lng, lat)) return;
  readout.look(lng, lat);
  readout.pin([lng, lat]);
});

// Somebody's address, pasted over ours; what we write there ourselves is no such event.
window.addEventListener("hashchange", () => location.reload());

bindControls(actions);
byId("menu").addEventListener("click", ({ target }) => {
  // On a phone it covers the map that these are about.
  if (["line", "bare", "help"].includes(target.dataset.act)) actions.less();
});
paint();
if (wanted.pin) readout.pin(wanted.pin);
if (wanted.line) profile.set(wanted.line);
showStatus(await firstStatus);
tiles.addTo(map); // not before it is known where the map is
feed.start();
// For tests and for the curious: what the page knows.
window.gpom = { map, tiles, robots, state };
