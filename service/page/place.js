// Metres and Leaflet: x is longitude, y is latitude, 2^zoom pixels to the metre (CRS.Simple).

export const at = (x, y) => L.latLng(y, x);

export const boxOf = ([x0, y0, x1, y1]) => L.latLngBounds(at(x0, y0), at(x1, y1));

/** A round number of metres: 1, 2 or 5 times a power of ten, not below `least`. */
export function round125(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return power * [1, 2, 5, 10].find((step) => step * power >= least * 0.999);
}

export function metres(value, step = 0.01) {
  const digits = Math.max(0, Math.min(3, Math.ceil(-Math.log10(step))));
  return value.toFixed(digits).replace("-", "−");
}

export function lengthText(m) {
  if (m >= 1000) return `${m / 1000} km`;
  return m >= 1 ? `${m} m` : m >= 0.01 ? `${Math.round(m * 100)} cm` : `${Math.round(m * 1000)} mm`;
}

export function createMap(element) {
  return L.map(element, {
    crs: L.CRS.Simple,
    minZoom: -4,
    maxZoom: 9,
    zoomControl: false,
    attributionControl: false,
    fadeAnimation: false, // tiles come decoded; fading each in would draw the whole map again and again
    preferCanvas: true,
    wheelPxPerZoomLevel: 90,
    maxBoundsViscosity: 0,
  });
}
