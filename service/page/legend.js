// What the colours mean; they come from the service, which also draws with them.

export function drawLegend(box, layer, { colors, variance_max: most }, clusters) {
  const unknown = '<span><i class="unknown"></i>unknown</span>';
  const parts = {
    occupancy: () => `<h2>Probability of being occupied</h2><div class="ramp"></div>
      <div class="ends"><span>0 free</span><span>0.5</span><span>1 occupied</span></div>
      <div class="keys">${unknown}</div>`,
    variance: () => `<h2>Variance</h2><div class="ramp"></div>
      <div class="ends"><span>0 sure</span><span>${most.toFixed(2)} unsure</span></div>
      <div class="keys">${unknown}</div>`,
    state: () => `<h2>Most likely</h2><div class="keys"><span><i></i>free</span>
      <span><i></i>occupied</span>${unknown}</div>`,
  };
  box.innerHTML = parts[layer]() + (clusters
    ? '<div class="keys muted">solid: cluster · dashed: waits for training</div>' : "");
  // Styles are set by script: the page allows none in its markup.
  const ramp = box.querySelector(".ramp");
  if (ramp) ramp.style.backgroundImage = `linear-gradient(90deg, ${colors.join(", ")})`;
  else box.querySelectorAll("i:not(.unknown)").forEach((key, i) => { key.style.background = colors[i]; });
}
