"use strict";
(() => {
  const root = document.documentElement;

  // A browser that goes back to the page restores checkboxes and lists: apply each control once at the start.
  function connect(controls, apply) {
    for (const control of controls) {
      control.addEventListener("change", () => apply(control));
      apply(control);
    }
  }

  connect(document.querySelectorAll("[data-toggles]"), (checkbox) => {
    for (const element of document.querySelectorAll(`[data-estimator="${checkbox.dataset.toggles}"]`)) {
      element.style.display = checkbox.checked ? "" : "none";
    }
  });

  // Body rates as uPlot draws them: measured, predicted, and the band of the errors. All plots zoom together.
  const box = document.getElementById("rates"), list = document.getElementById("horizon");
  let plots = [];
  const size = () => ({ width: box.clientWidth, height: 170 });
  const color = (name) => {
    box.style.color = `var(${name})`;
    return getComputedStyle(box).color;
  };
  function drawRates() {
    if (!box) return;
    const given = JSON.parse(box.dataset.rates), at = list.selectedIndex;
    const [grid, soft, ink] = ["--grid", "--soft", "--ink"].map(color);
    const time = given.start.map((start) => start + Number(given.horizons[at]));
    const text = (_, value) => (value == null ? "–" : value.toFixed(3));
    const axis = { stroke: soft, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1 } };
    plots.forEach((plot) => plot.destroy());
    plots = ["p", "q", "r"].map((name, rate) => {
      const y = given.predicted[at][rate], half = given.half[at][rate];
      const moved = (by) => y.map((value) => (value == null ? null : value + by));
      const edge = (label) => ({ label, value: text, width: 0, points: { show: false } });
      const options = {
        ...size(),
        cursor: { sync: { key: "rates" } },
        scales: { x: { time: false } },
        axes: [{ ...axis, size: 30 }, { ...axis, label: `${name} [rad/s]`, size: 45, labelSize: 20 }],
        series: [
          { label: "time [s]", value: text },
          { label: "measured", value: text, stroke: ink, width: 1, dash: [3, 3], points: { show: false } },
          { label: "predicted", value: text, stroke: given.color, width: 2, points: { show: false } },
          edge(`${given.band} low`),
          edge("high"),
        ],
        bands: [{ series: [4, 3], fill: `${given.color}38` }],
      };
      return new uPlot(options, [time, given.measured[at][rate], y, moved(-half), moved(half)], box);
    });
  }
  if (box) {
    const { horizons, shown } = JSON.parse(box.dataset.rates);
    list.replaceChildren(...horizons.map((name, i) => new Option(`${name} s`, i, i === shown, i === shown)));
    list.addEventListener("change", drawRates);
    drawRates();
    addEventListener("resize", () => plots.forEach((plot) => plot.setSize(size())));
  }

  const dark = matchMedia("(prefers-color-scheme: dark)");
  const button = document.getElementById("theme");
  const current = () => root.dataset.theme || (dark.matches ? "dark" : "light");
  const name = () => {
    button.textContent = current() === "dark" ? "Light" : "Dark";
    button.setAttribute("aria-label", `Switch to ${button.textContent.toLowerCase()} colours`);
  };
  button.addEventListener("click", () => {
    root.dataset.theme = current() === "dark" ? "light" : "dark";
    name();
    drawRates();
  });
  dark.addEventListener("change", () => {
    name();
    drawRates();
  });
  name();
})();
