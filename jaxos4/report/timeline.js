"use strict";
// Signals on one time axis, drawn by uPlot. All panels zoom together; the zoom survives another view and another theme.
(() => {
  const box = document.getElementById("timeline");
  if (!box) return;
  const given = JSON.parse(box.dataset.signals), { pieces, shaded } = given;
  const list = document.getElementById("view"), range = document.getElementById("range");
  const slider = document.getElementById("start");
  const last = pieces[pieces.length - 1], whole = [pieces[0][0], last[0] + last[2] - last[1]];
  let shown = whole, plots = [];

  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  const times = (text) => Array.from(new Float32Array(bytes(text)));
  const values = ([middle, step, text]) =>
    Array.from(new Int16Array(bytes(text)), (level) => (level === -32768 ? null : middle + step * level));
  const integers = (text) => Array.from(new Int16Array(bytes(text)));
  const text = (value) => (value == null ? "" : String(Number(value.toPrecision(4))));
  // Labels have as many decimals as the distance of the ticks.
  function labels(places, step) {
    let digits = 0;
    while (digits < 9 && Math.abs(step * 10 ** digits - Math.round(step * 10 ** digits)) > 1e-6) digits++;
    return places.map((x) => String(Number(own(x).toFixed(digits))));
  }
  // How a line is dashed, for readers who see no colours.
  const mark = (dash) => (dash.length === 0 ? "—" : dash.length > 2 ? "- ·" : dash[0] > 4 ? "- -" : "···");
  const color = (name) => {
    box.style.color = `var(${name})`;
    return getComputedStyle(box).color;
  };

  // The axis has no gaps: from a place on it to the log's own time.
  const pieceAt = (x) => pieces.findLast((piece) => piece[0] <= x) ?? pieces[0];
  const own = (x) => pieceAt(x)[1] + x - pieceAt(x)[0];
  function ticks(_, axis, low, high, step) {
    const found = [];
    for (const [at, begin, end] of pieces) {
      const from = Math.max(low, at) - at + begin, to = Math.min(high, at + end - begin) - at + begin;
      for (let k = Math.ceil(from / step - 1e-9); k * step <= to + 1e-9 * step; k++) {
        const x = at + k * step - begin;
        if (!found.length || x - found[found.length - 1] > 0.7 * step) found.push(x);
      }
    }
    return found;
  }

  function zoom(low, high) {
    const length = Math.min(Math.max(high - low, 1e-3), whole[1] - whole[0]);
    const begin = Math.min(Math.max(low, whole[0]), whole[1] - length);
    shown = [begin, begin + length];
    for (const plot of plots) plot.setScale("x", { min: shown[0], max: shown[1] });
    if (range) range.textContent = `--begin ${own(shown[0]).toFixed(2)} --end ${own(shown[1]).toFixed(2)}`;
  }

  // A part was chosen in one panel. A panel tells what it shows later than it was told to.
  function follow({ min, max }) {
    if (Math.abs(min - shown[0]) + Math.abs(max - shown[1]) > 1e-6 * (shown[1] - shown[0])) zoom(min, max);
  }

  // Grey where a part is not used or not fitted; a line where another part or log begins, with its name above.
  function background(plot) {
    const { ctx, bbox } = plot, x = (at) => plot.valToPos(at, "x", true);
    const low = plot.scales.x.min, first = pieceAt(low)[3]; // of the logs that began before, one has a name
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.fillStyle = color("--shade");
    for (const [low, high] of shaded) ctx.fillRect(x(low), bbox.top, x(high) - x(low), bbox.height);
    ctx.fillStyle = color("--soft");
    ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
    pieces.forEach(([at, , , name], i) => {
      const isNew = i === 0 || name !== pieces[i - 1][3];
      if (i) ctx.fillRect(x(at) - devicePixelRatio, bbox.top, (isNew ? 2 : 1) * devicePixelRatio, bbox.height);
      if (name && isNew && plot === plots[0] && (at >= low || name === first)) {
        ctx.fillText(name, Math.max(x(at), bbox.left) + 4 * devicePixelRatio, bbox.top + 12 * devicePixelRatio);
      }
    });
    ctx.restore();
  }

  function plot(title, height, time, lines, half, reach) {
    const [grid, soft, ink] = ["--grid", "--soft", "--ink"].map(color);
    const axis = { stroke: soft, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1 } };
    const y = lines.map((line) => line.values);
    const series = lines.map((line) => ({
      label: `${line.label} ${mark(line.dash)}`,
      value: (_, value) => text(value),
      stroke: line.color ?? ink,
      width: line.color ? 1.6 : 1,
      dash: line.dash,
      points: { show: false },
      spanGaps: line.joined ?? false,
    }));
    const bands = [];
    if (half) {
      const moved = (by) => y[lines.length - 1].map((value) => (value == null ? null : value + by));
      y.push(moved(-half), moved(half));
      const edge = { width: 0, points: { show: false }, value: () => "", class: "edge" };
      series.push({ ...edge }, { ...edge });
      bands.push({ series: [lines.length + 2, lines.length + 1], fill: `${lines[lines.length - 1].color}38` });
    }
    const options = {
      width: box.clientWidth,
      height,
      cursor: { sync: { key: "time", scales: ["x", null] }, bind: { dblclick: () => () => zoom(...whole) } },
      scales: { x: { time: false }, y: reach ? { range: [-reach, reach] } : {} },
      legend: { show: lines.length > 1 || !plots.length }, // the first one has the time
      axes: [
        { ...axis, size: 28, splits: ticks, values: (_, at, axis, space, step) => labels(at, step) },
        { ...axis, label: title, size: 52, labelSize: 20, space: height < 120 ? 14 : 22 },
      ],
      series: [{ label: "time [s]", value: (_, x) => (x == null ? "" : own(x).toFixed(3)) }, ...series],
      bands,
      hooks: {
        drawClear: [background],
        setScale: [(self, key) => key === "x" && plots.includes(self) && follow(self.scales.x)],
      },
    };
    plots.push(new uPlot(options, [time, ...y], box));
  }

  // Of the predictions from many starts, only those from the chosen one are drawn.
  function chosen(line, start) {
    const found = values(line.values), number = Number(slider?.value);
    if (!start || line.color == null) return { ...line, values: found };
    return { ...line, values: found.map((value, i) => (start[i] === number ? value : null)), joined: true };
  }

  // Times and lines of each panel of a view, with the earlier samples that all views have.
  function merged(view) {
    const before = given.common.includes(view) ? null : given.before, head = before ? times(before.time) : [];
    const start = view.start && integers(view.start), all = [...head, ...times(view.time)];
    const order = all.map((_, i) => i).sort((i, j) => all[i] - all[j]);
    const panels = view.panels.map((panel, k) => ({
      ...panel,
      lines: panel.lines.map((each, j) => {
        const line = chosen(each, start);
        const earlier = before && j === 0 ? values(before.panels[k].lines[0].values) : head.map(() => null);
        const both = [...earlier, ...line.values];
        return { ...line, values: order.map((i) => both[i]) };
      }),
    }));
    return { time: order.map((i) => all[i]), panels };
  }

  // A start was chosen: what follows it is shown.
  function reach() {
    const view = given.views[list.selectedIndex], several = view.start != null;
    slider.parentElement.hidden = !several;
    if (several) {
      const start = integers(view.start), number = Number(slider.value);
      const at = times(view.time).filter((_, i) => start[i] === number);
      const low = at[0], high = at[at.length - 1], length = 4 * (high - low), middle = (low + high) / 2;
      slider.max = Math.max(...start);
      slider.setAttribute("aria-valuetext", slider.nextElementSibling.textContent = `${own(low).toFixed(2)} s`);
      const isNear = shown[0] < low && high < shown[1] && shown[1] - shown[0] < 2 * length;
      if (!isNear) shown = [middle - length / 2, middle + length / 2];
    }
    draw();
  }

  function draw() {
    plots.forEach((each) => each.destroy());
    plots = [];
    const views = given.views.length ? [given.views[list.selectedIndex], ...given.common] : given.common;
    for (const view of views) {
      const { time, panels } = merged(view);
      for (const { title, lines, half, residual, reach } of panels) {
        plot(title, 160, time, lines, half, reach);
        if (residual) {
          const [first, other] = [lines[0].values, lines[lines.length - 1].values];
          const left = first.map((value, i) => (value == null || other[i] == null ? null : value - other[i]));
          const { color, joined } = lines[lines.length - 1];
          plot("residual", 95, time, [{ label: "measured - predicted", values: left, color, joined, dash: [] }], 0, 0);
        }
      }
    }
    zoom(...shown);
  }

  // Fingers: one moves along the axis, two zoom. The page scrolls up and down as ever.
  const fingers = new Map();
  const at = (position, [low, high]) => {
    const { left, width } = plots[0].over.getBoundingClientRect();
    return low + ((high - low) * (position - left)) / width;
  };
  box.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "touch") fingers.set(event.pointerId, event.clientX);
  });
  box.addEventListener("pointermove", (event) => {
    if (!fingers.has(event.pointerId)) return;
    const before = [...fingers.values()].slice(0, 2).map((position) => at(position, shown));
    fingers.set(event.pointerId, event.clientX);
    const [a, b] = [...fingers.values()].map((position) => at(position, [0, 1]));
    const moved = before[0] - at(event.clientX, shown);
    if (b === undefined) zoom(shown[0] + moved, shown[1] + moved);
    else if (Math.abs(b - a) > 0.02) {
      const length = Math.abs((before[1] - before[0]) / (b - a)), low = before[0] - a * length;
      zoom(low, low + length);
    }
  });
  for (const end of ["pointerup", "pointercancel", "pointerleave"]) {
    box.addEventListener(end, (event) => fingers.delete(event.pointerId));
  }

  const moves = { in: [0.25, -0.25], out: [-0.5, 0.5], back: [-0.5, -0.5], on: [0.5, 0.5] };
  for (const button of document.querySelectorAll("[data-zoom]")) {
    button.addEventListener("click", () => {
      const length = shown[1] - shown[0], [low, high] = moves[button.dataset.zoom] ?? [];
      if (low === undefined) zoom(...whole);
      else zoom(shown[0] + low * length, shown[1] + high * length);
    });
  }
  document.getElementById("copy")?.addEventListener("click", () => navigator.clipboard?.writeText(range.textContent));
  list?.replaceChildren(...given.views.map(({ name }, i) => new Option(name, i, i === given.shown, i === given.shown)));
  if (list) list.parentElement.hidden = given.views.length < 2;
  box.parentElement.querySelector(".tools").hidden = false;
  list?.addEventListener("change", reach);
  slider?.addEventListener("input", reach);
  document.addEventListener("theme", draw);
  addEventListener("resize", () => {
    for (const each of plots) each.setSize({ width: box.clientWidth, height: each.height });
  });
  draw();
})();
