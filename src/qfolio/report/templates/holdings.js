/* The picture of holdings: a row for each asset, its weight against the reference's in color, and
   the effective number of assets below. Names and weights stand beside the rows. */
"use strict";
(() => {
  const { data, dark, narrow, coarse, state, byId, color, percent, layout, options,
    TOP, BOTTOM } = tools;
  const { dates, series: all, reference, effective } = data.weights;
  const tall = () => (state.printing ? [13, 72] : [23, 130]); // of a row, and of the panel below
  let chosen = Number(byId("weights-strategy").value);

  /** The rows from top to bottom: the largest first, cash at the end. */
  const rows = (series) => [...series.names.keys()].slice(1).concat(0);
  const margin = () => (narrow.matches ? { l: 92, r: 58 } : { l: 150, r: 66 });

  /** Half of the width of the colors: most values of single assets are within it. */
  function reach(series) {
    const single = series.others ? series.active.slice(0, -1) : series.active;
    const sizes = single.flat().map(Math.abs).sort((a, b) => a - b);
    return Math.max(sizes[Math.floor(0.99 * (sizes.length - 1))], 0.005);
  }

  function draw() {
    const series = all[chosen], order = rows(series), alone = reference === null || chosen === reference;
    const [row, panel] = tall(), inner = row * order.length + 40 + panel;
    const edge = reach(series);
    const share = (row * order.length) / inner;
    const map = {
      type: "heatmap", x: dates, y: order.map((_, place) => place),
      z: order.map((place) => series.active[place]), zmin: alone ? 0 : -edge, zmax: edge,
      colorscale: alone ? [[0, color("paper")], [1, color("accent")]]
        : [[0, color("second")], [0.5, color("paper")], [1, color("accent")]],
      showscale: false, hoverinfo: "none", ygap: 2,
    };
    const line = (y, ink, width) => ({
      x: dates, y, yaxis: "y2", type: "scatter", mode: "lines", hoverinfo: "none",
      line: { color: color(ink), width },
    });
    const below = panel / inner;
    const traces = [map, ...(alone ? [] : [line(effective, "ink", 1)]),
      line(series.effective, "accent", 1.8)];
    say(alone, edge);
    return Plotly.react(byId("weights"), traces, layout(inner + TOP + BOTTOM, {
      margin: margin(),
      titles: [[alone ? "Weight" : "Active weight", 1], ["Effective number of assets", below]],
      // On paper, more dates would be turned to fit, and cut off.
      xaxis: { anchor: "y2", ...(state.printing && { nticks: 5 }) },
      yaxis: { domain: [1 - share, 1], range: [order.length - 0.5, -0.5], visible: false,
        showgrid: false },
      yaxis2: { domain: [0, below], rangemode: "tozero", nticks: 4 },
    }), { ...options("holdings"), displayModeBar: false }).then(() => list(order));
  }

  /** Says what the colors mean. */
  function say(alone, edge) {
    byId("weights-what").textContent = alone ? "Weights after each trade"
      : "Weights after each trade, less those of the reference: blue is more, orange is less";
    const scale = byId("weights-scale"), [low, high] = scale.querySelectorAll("span");
    scale.classList.toggle("alone", alone);
    low.textContent = percent(alone ? 0 : -edge);
    high.textContent = percent(edge) + (alone ? "" : ", against the reference");
  }

  /** The start of a name, which gives way where room is short, and its end, where names differ. */
  const parts = (name) => [name.slice(0, -10), name.slice(-10)].map((text) =>
    Object.assign(document.createElement("bdi"), { textContent: text }));

  /** Names at the left of the rows, and weights at the right. */
  function list(order) {
    const place = byId("weights-list"), chart = byId("weights");
    const { _offset: top, _length: height } = chart._fullLayout.yaxis;
    const { l, r } = margin();
    const width = chart._fullLayout.width;
    const add = (text, kind, at, left, wide) => {
      const span = document.createElement("span");
      span.className = kind;
      span.append(...parts(text));
      Object.assign(span.style,
        { top: `${at}px`, left: `${left}px`, width: `${wide}px` });
      place.append(span);
    };
    place.replaceChildren();
    add("", "now head", top - 12, 0, width);
    order.forEach((row, i) => {
      const at = top + ((i + 0.5) * height) / order.length;
      add(all[chosen].names[row], "row", at, 0, l - 8);
      add("", "now", at, width - r, r);
    });
    read(dates.length - 1);
  }

  /** Shows the weights at a date. */
  function read(index) {
    const series = all[chosen], order = rows(series);
    const [head, ...cells] = byId("weights-list").querySelectorAll(".now");
    head.textContent = `weight, ${dates[index]}`;
    cells.forEach((cell, i) => { cell.textContent = percent(series.values[order[i]][index]); });
  }

  byId("weights-strategy").addEventListener("change", (event) => {
    chosen = Number(event.target.value);
    draw();
  });
  draw();
  const reached = (event) => {
    const index = dates.findIndex((date) => date >= String(event.points[0].x).slice(0, dates[0].length));
    read(index < 0 ? dates.length - 1 : index);
  };
  byId("weights").on("plotly_hover", reached);
  byId("weights").on("plotly_click", reached); // all that a tap causes
  byId("weights").on("plotly_unhover", () => read(dates.length - 1));
  for (const query of [dark, narrow, coarse]) query.addEventListener("change", draw);
  addEventListener("resize", draw);
  addEventListener("beforeprint", draw);
  addEventListener("afterprint", draw);
})();
