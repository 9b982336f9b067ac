"use strict";
(() => {
  const specs = JSON.parse(document.getElementById("charts").textContent);
  const root = document.documentElement;
  const hidden = new Set();
  const charts = [...document.querySelectorAll(".chart")];
  const drawn = new Set();
  const toggles = [...document.querySelectorAll("[data-toggles]")];
  const color = (name) => getComputedStyle(root).getPropertyValue(name).trim();

  // One panel of a chart: its axes take their share of a grid of so many columns and rows.
  function axes(panel, number, columns, rows, chart) {
    const suffix = number ? String(number + 1) : "";
    const column = number % columns;
    const row = Math.floor(number / columns);
    const gapX = columns > 1 ? 0.055 : 0;
    const gapY = rows > 1 ? Math.min(62 / (chart.height * rows), 0.8 / rows) : 0;
    const wide = (1 - gapX * (columns - 1)) / columns;
    const high = (1 - gapY * (rows - 1)) / rows;
    const left = column * (wide + gapX);
    const bottom = Math.max(1 - row * (high + gapY) - high, 0);
    const common = { gridcolor: color("--grid"), linecolor: color("--faint"), zeroline: false, showline: true };
    const axis = (given, anchor, domain) => {
      const made = { ...common, type: given.type || "linear", domain, anchor };
      if (given.title) made.title = { text: given.title, standoff: 6 };
      if (given.ticks) Object.assign(made, { tickvals: given.ticks, ticktext: given.labels });
      else if (made.type === "log") Object.assign(made, { tickformat: "~g", dtick: given.dense ? "D2" : 1 });
      if (given.autorange) made.autorange = given.autorange;
      return made;
    };
    const x = axis(panel.x, "y" + suffix, [left, left + wide]);
    const y = axis(panel.y, "x" + suffix, [bottom, Math.min(bottom + high, 1)]);
    if (number && panel.y.shared) y.matches = "y"; // one scale for all panels, also when one is zoomed
    if (column && panel.y.type === "category") y.showticklabels = false;
    if (row < rows - 1 && number + columns < chart.count) delete x.title;
    y.automargin = column === 0;
    return { ["xaxis" + suffix]: x, ["yaxis" + suffix]: y };
  }

  function lines(panel, suffix) {
    const line = { color: color("--ink"), width: 1 };
    const across = "line_at" in panel.y ? [panel.y.line_at] : [];
    const up = panel.x.lines_at || [];
    return [
      ...across.map((at) => ({
        type: "line", layer: "below", line, xref: `x${suffix} domain`, x0: 0, x1: 1, yref: `y${suffix}`, y0: at, y1: at,
      })),
      ...up.map((at) => ({
        type: "line", layer: "below", line: { ...line, dash: at ? "dash" : "solid", color: color(at ? "--faint" : "--ink") },
        yref: `y${suffix} domain`, y0: 0, y1: 1, xref: `x${suffix}`, x0: at, x1: at,
      })),
    ];
  }

  function escaped(text) {
    return text.replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
  }

  function themed(trace) {
    const ink = color("--ink");
    const made = { ...trace };
    if (made.line && made.line.color === "ink") made.line = { ...made.line, color: ink };
    if (made.marker && made.marker.color === "ink") made.marker = { ...made.marker, color: ink };
    return made;
  }

  function draw(box) {
    const spec = specs[box.dataset.chart];
    const panels = spec.choices[Number(box.dataset.choice || spec.chosen)].panels;
    const width = box.clientWidth;
    const columns = Math.min(panels.length, spec.columns || 4, width >= 900 ? 4 : width >= 560 ? 2 : 1);
    const rows = Math.ceil(panels.length / columns);
    const above = 24;
    // Room for the axis' title and for the legend, which takes more lines where there is less width.
    const legend = panels.some((panel) => panel.traces.some((trace) => trace.type !== "box"));
    const below = 52 + (legend ? 22 * Math.ceil((145 * (spec.entries || toggles.length + 2)) / width) : 0);
    const layout = {
      height: spec.height * rows + above + below,
      margin: { l: 48, r: 8, t: above, b: below },
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: color("--ink"), size: 12, family: "system-ui, sans-serif" },
      hoverlabel: { bgcolor: color("--panel"), bordercolor: color("--faint"), font: { color: color("--ink") } },
      legend: { orientation: "h", yref: "container", y: 0, yanchor: "bottom", x: 0 },
      dragmode: matchMedia("(pointer: coarse)").matches ? false : "zoom",
      hovermode: "closest",
      annotations: [],
      shapes: [],
    };
    const traces = [];
    const named = new Set();
    panels.forEach((panel, number) => {
      const suffix = number ? String(number + 1) : "";
      Object.assign(layout, axes(panel, number, columns, rows, { ...spec, count: panels.length }));
      layout.shapes.push(...lines(panel, suffix));
      const place = { xref: `x${suffix} domain`, yref: `y${suffix} domain`, showarrow: false, x: 0, xanchor: "left" };
      layout.annotations.push({ ...place, y: 1, yanchor: "bottom", text: `<b>${escaped(panel.title)}</b>` });
      if (panel.note) {
        layout.annotations.push({ ...place, y: 1, yanchor: "top", text: escaped(panel.note), font: { size: 10 } });
      }
      for (const trace of panel.traces) {
        if (hidden.has(trace.estimator)) continue;
        const axesOfTrace = { xaxis: "x" + suffix, yaxis: "y" + suffix };
        const once = { legendgroup: trace.name, showlegend: !named.has(trace.name) && trace.type !== "box" };
        const safe = { name: escaped(trace.name) };
        if (trace.type === "box") safe.y = trace.y.map(escaped);
        traces.push({ ...themed(trace), ...axesOfTrace, ...once, ...safe });
        named.add(trace.name);
      }
    });
    drawn.add(box);
    Plotly.react(box, traces, layout, { responsive: false, displaylogo: false, displayModeBar: "hover" });
  }

  // Charts far down are drawn when they come near: a study can have many.
  const near = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (entry.isIntersecting && !drawn.has(entry.target)) draw(entry.target);
    }
  }, { rootMargin: "600px" });
  window.addEventListener("beforeprint", () => charts.forEach((box) => drawn.has(box) || draw(box)));

  for (const box of charts) {
    const spec = specs[box.dataset.chart];
    box.style.minHeight = `${spec.height + 110}px`;
    if (spec.choices.length > 1) {
      const label = document.createElement("label");
      const select = document.createElement("select");
      spec.choices.forEach((choice, at) => select.add(new Option(choice.label, at, false, at === spec.chosen)));
      select.addEventListener("change", () => {
        box.dataset.choice = select.value;
        draw(box);
      });
      label.append("Shown: ", select);
      box.before(label);
    }
    near.observe(box);
  }

  function drawAgain() {
    for (const box of drawn) draw(box);
  }

  for (const input of toggles) {
    const place = Number(input.dataset.toggles);
    const apply = () => {
      if (input.checked) hidden.delete(place);
      else hidden.add(place);
      for (const element of document.querySelectorAll(`[data-estimator="${place}"]`)) {
        element.style.display = input.checked ? "" : "none";
      }
    };
    input.addEventListener("change", () => {
      apply();
      drawAgain();
    });
    apply(); // a browser that goes back to the page keeps what was checked
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
    drawAgain();
  });
  dark.addEventListener("change", () => {
    name();
    drawAgain();
  });
  name();

  let width = innerWidth;
  let timer = 0;
  addEventListener("resize", () => {
    if (innerWidth === width) return;
    width = innerWidth;
    clearTimeout(timer);
    timer = setTimeout(drawAgain, 150);
  });
})();
