// The picture of the map: tiles that are asked for again only where the map has changed, and
// replaced only when the service says, by their ETag, that they differ.

const AT_ONCE = 6; // as many as browsers ask one address at once
const TRIES = 6;
const RETINA = window.devicePixelRatio > 1.3 ? 1 : 0;

export const LiveTiles = L.GridLayer.extend({
  options: {
    tileSize: 256 >> RETINA,
    keepBuffer: 3,
    updateWhenIdle: false,
    updateInterval: 120,
    minZoom: -4,
    maxZoom: 9,
    className: "tiles",
  },

  initialize(layer, theme) {
    L.GridLayer.prototype.initialize.call(this);
    this._look = { layer, theme };
    this._waiting = new Set();
    this._busy = 0;
    this.on("tileunload", ({ tile }) => {
      this._waiting.delete(tile);
      tile.live.abort.abort();
    });
  },

  /** Show another layer or theme; what is on the screen stays until its successor is there. */
  look(layer, theme) {
    this._look = { layer, theme };
    for (const { el } of Object.values(this._tiles)) el.live.etag = "";
    this.changed(null);
  },

  /** Ask again for the tiles in a box (L.LatLngBounds); null is all. */
  changed(box) {
    for (const { el, coords } of Object.values(this._tiles)) {
      if (!box || this._tileCoordsToBounds(coords).intersects(box)) this._waiting.add(el);
    }
    this._work();
  },

  /** Whether every tile on the screen is as new as was told. */
  settled() {
    return this._busy === 0 && this._waiting.size === 0 && !this._loadingTiles();
  },

  createTile(coords, done) {
    const tile = document.createElement("img");
    tile.className = "tile";
    tile.alt = "";
    tile.live = { coords, done, etag: "", asked: 0, tries: 0, busy: false, abort: new AbortController() };
    this._waiting.add(tile);
    this._work();
    return tile;
  },

  _loadingTiles() {
    return Object.values(this._tiles).some((tile) => !tile.loaded);
  },

  _work() {
    while (this._busy < AT_ONCE) {
      const tile = this._nearest(); // a name for each turn: what fails must know which one it was
      if (!tile) return;
      const { live } = tile;
      this._waiting.delete(tile);
      this._busy += 1;
      live.busy = true;
      this._load(tile).catch(() => this._again(tile)).finally(() => {
        this._busy -= 1;
        live.busy = false;
        this._work();
      });
    }
  },

  /** New tiles first, then drafts, from the middle outwards; then what was asked for longest ago. */
  _nearest() {
    const size = this.getTileSize();
    const middle = this._map.project(this._map.getCenter()).unscaleBy(size);
    let best = null;
    let least = Infinity;
    for (const tile of this._waiting) {
      const { coords, done, etag, asked, busy } = tile.live;
      if (busy) continue; // its turn comes when what is under way is there
      const far = Math.hypot(coords.x + 0.5 - middle.x, coords.y + 0.5 - middle.y);
      // By turns: where robots drive, tiles change faster than they come.
      const rank = done ? far : etag === "" ? 1e3 + far : 1e6 + asked;
      if (rank < least) [best, least] = [tile, rank];
    }
    return best;
  },

  async _load(tile) {
    const { live } = tile;
    const { x, y, z } = live.coords;
    live.asked = performance.now();
    const { layer, theme } = this._look;
    const address = `v1/tiles/${layer}/${z + RETINA}/${x}/${y}.png?theme=${theme}${live.done ? "&draft=1" : ""}`;
    // The browser sends the ETag along, and answers from its cache when nothing changed.
    const answer = await fetch(address, { signal: live.abort.signal });
    if (!answer.ok) throw new Error(`${answer.status}`);
    const etag = answer.headers.get("ETag"); // none: a draft
    live.tries = 0;
    if (etag === null || etag !== live.etag) {
      live.etag = etag ?? "";
      await show(tile, await answer.blob(), Boolean(live.done));
    }
    if (etag === null) this._waiting.add(tile); // the real one, when all drafts are there
    const { done } = live;
    live.done = null;
    done?.(null, tile);
  },

  _again(tile) {
    const { live } = tile;
    if (live.abort.signal.aborted) return;
    live.tries += 1;
    if (live.tries > TRIES) {
      live.done?.(null, tile); // the next change or reconnection asks again
      live.done = null;
      live.tries = 0;
      return;
    }
    setTimeout(() => {
      if (live.abort.signal.aborted) return;
      this._waiting.add(tile);
      this._work();
    }, 300 * 2 ** live.tries);
  },
});

async function show(tile, blob, first) {
  const address = URL.createObjectURL(blob);
  try {
    if (!first) {
      // Decoded before it is swapped in, so that a refresh never flickers.
      const picture = new Image();
      picture.src = address;
      await picture.decode();
    }
    await new Promise((done, fail) => {
      Object.assign(tile, { onload: done, onerror: fail, src: address });
    });
  } finally {
    URL.revokeObjectURL(address);
  }
}
