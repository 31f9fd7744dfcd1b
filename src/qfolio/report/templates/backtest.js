/* The charts of a backtest report. Names that users give never reach plotly, which would read
   markup in them: the charts carry numbers only, and names stand in the page beside them. */
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const narrow = matchMedia("(max-width: 40rem)");
  const coarse = matchMedia("(pointer: coarse)");
  const hidden = new Set(data.hidden);
  let printing = false;
  let chosen = 0;

  const MARGIN = 44; // left of an axis, for its numbers
  const SPACE = "\u202f", MINUS = "\u2212";
  const SANS = getComputedStyle(document.documentElement).getPropertyValue("--sans").trim();
  const byId = (id) => document.getElementById(id);
  const last = (values) => values[values.length - 1];
  const colour = (name) => data.themes[dark.matches && !printing ? "dark" : "light"][name] || name;
  const translucent = (hex, alpha) => hex + Math.round(255 * alpha).toString(16).padStart(2, "0");
  const dashes = (pattern) => pattern && pattern.split(" ").map((part) => part + "px").join(",");

  function number(value, digits) {
    if (value === null || value === undefined) return "–";
    const text = Math.abs(value).toFixed(digits).replace(/\B(?=(\d{3})+(?!\d))/g, SPACE);
    return (value < 0 && /[1-9]/.test(text) ? MINUS : "") + text;
  }
  const percent = (value, digits = 1) =>
    value === null || value === undefined ? "–" : number(100 * value, digits) + SPACE + "%";
  const times = (value) => number(value, value >= 100 ? 0 : value >= 10 ? 1 : 2);
  const FORMATS = { wealth: times, drawdown: percent, cost: percent, turnover: percent };

  // Axes ------------------------------------------------------------------------------------

  function layout(height, more) {
    const text = colour("muted");
    return {
      height, width: printing ? 660 : undefined,
      paper_bgcolor: colour("paper"), plot_bgcolor: colour("paper"),
      font: { family: SANS, size: 12, color: text },
      margin: { l: MARGIN, r: 10, t: 26, b: 40 },
      showlegend: false, hovermode: "x", hoverdistance: -1, spikedistance: -1,
      dragmode: coarse.matches ? false : "zoom", uirevision: "kept",
      xaxis: {
        type: "date", showgrid: false, linecolor: text, ticks: "outside", tickcolor: text,
        ticklen: 4, nticks: narrow.matches ? 5 : 9,
        showspikes: true, spikemode: "across", spikesnap: "hovered data", spikedash: "solid",
        spikethickness: 1, spikecolor: colour("faint"), fixedrange: coarse.matches, ...more.xaxis,
      },
      ...Object.fromEntries(["yaxis", "yaxis2"].filter((name) => more[name]).map((name) => [name, {
        gridcolor: colour("hairline"), zeroline: false, fixedrange: true, ...more[name],
      }])),
      shapes: (more.shapes || []).map((shape) => ({
        type: "line", xref: "paper", x0: 0, x1: 1, layer: "below",
        line: { color: text, width: 1 }, ...shape,
      })),
      annotations: (more.titles || []).map(([title, y]) => ({
        text: title, x: 0, y, xref: "paper", yref: "paper", xanchor: "left", yanchor: "bottom",
        yshift: 5, xshift: -MARGIN, showarrow: false, font: { size: 12.5, color: colour("ink") },
      })),
    };
  }

  function options(name) {
    return {
      responsive: true, displaylogo: false, showTips: false, displayModeBar: coarse.matches ? false : "hover",
      modeBarButtons: [["toImage", "resetScale2d"]], doubleClick: "reset",
      toImageButtonOptions: { format: "png", filename: `qfolio-${name}`, scale: 2 },
    };
  }

  /** Round numbers between two positive ones, evenly spread on a log axis. */
  function logTicks(low, high) {
    const decades = Math.log10(high / low);
    const steps = decades > 4 ? [1] : decades > 1.6 ? [1, 2, 5] : decades > 0.7
      ? [1, 1.5, 2, 3, 5, 7] : [1, 1.2, 1.4, 1.6, 1.8, 2, 2.5, 3, 3.5, 4, 5, 6, 7, 8, 9];
    const ticks = [];
    for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power += 1) {
      for (const step of steps) {
        const tick = step * 10 ** power;
        if (tick >= low && tick <= high) ticks.push(tick);
      }
    }
    if (ticks.length > 2) return ticks;
    const rough = (high - low) / 4; // so near to each other that a plain axis would do
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
    const from = Math.ceil(low / step);
    return Array.from({ length: Math.floor(high / step) - from + 1 }, (_, i) => (from + i) * step);
  }
  const tidy = (value) => String(Number(value.toPrecision(5))).replace("-", MINUS);

  /** The places of the dates that the chart shows now, from first to one after the last. */
  function inView(chart, dates) {
    const axis = chart.layout && chart.layout.xaxis;
    if (!axis || axis.autorange !== false || !axis.range) return [0, dates.length];
    const [left, right] = axis.range.map((end) => new Date(end).getTime());
    const at = dates.map((date) => new Date(date).getTime());
    const inside = at.map((time, i) => (time >= left && time <= right ? i : -1)).filter((i) => i >= 0);
    return inside.length > 1 ? [inside[0], last(inside) + 1] : [0, dates.length];
  }

  function extent(lists, [from, to]) {
    let low = Infinity, high = -Infinity;
    for (const list of lists) {
      for (let i = from; i < to; i += 1) {
        if (list[i] === null) continue;
        if (list[i] < low) low = list[i];
        if (list[i] > high) high = list[i];
      }
    }
    return low <= high ? [low, high] : null;
  }

  const shown = () => data.strategies.filter((_, index) => !hidden.has(index));

  // Lines of all strategies -----------------------------------------------------------------

  /** A line for each strategy, agents on top; a main one with the bands and marks of agents. */
  function lines(key, dates, axis, main) {
    const order = data.strategies.map((_, i) => i).reverse();
    return order.flatMap((index) => {
      const strategy = data.strategies[index];
      const ink = colour(strategy.colour);
      const base = {
        x: dates, yaxis: axis, type: "scatter", mode: "lines", meta: index,
        visible: !hidden.has(index), hoverinfo: "skip",
      };
      const result = [];
      if (key === "wealth" && strategy.band) {
        const edge = { ...base, line: { width: 0 } };
        result.push({ ...edge, y: strategy.band.low });
        result.push({ ...edge, y: strategy.band.high, fill: "tonexty",
          fillcolor: translucent(ink, 0.16) });
      }
      result.push({ ...base, y: strategy[key], hoverinfo: "none",
        line: { color: ink, width: (main ? 1 : 0.65) * strategy.width, dash: dashes(strategy.dash) || "solid" } });
      if (main && strategy.symbol) {
        // Shapes tell agents apart where colours do not; each begins at another place.
        const count = narrow.matches ? 4 : 7;
        const places = Array.from({ length: count }, (_, k) =>
          Math.round((dates.length - 1) * (k + 0.35 + 0.3 * (index % 3)) / count));
        result.push({ ...base, mode: "markers", x: places.map((i) => dates[i]),
          y: places.map((i) => strategy[key][i]),
          marker: { symbol: strategy.symbol, size: 8, color: ink,
            line: { width: 1.5, color: colour("paper") } } });
      }
      return result;
    });
  }

  function drawWealth() {
    const chart = byId("wealth");
    const view = inView(chart, data.dates);
    const tops = shown().flatMap((s) => [s.wealth, ...(s.band ? [s.band.low, s.band.high] : [])]);
    const [low, high] = extent(tops, view) || [0.9, 1.1];
    const margin = Math.max((high / low) ** 0.04, 1.01);
    const ticks = logTicks(low / margin, high * margin);
    const [deepest] = extent(shown().map((s) => s.drawdown), view) || [-0.01];
    return Plotly.react(chart,
      [...lines("wealth", data.dates, "y", true), ...lines("drawdown", data.dates, "y2", false)],
      layout(narrow.matches ? 480 : 590, {
        titles: [["Wealth, starting at 1 (log scale)", 1], ["Drawdown", 0.26]],
        xaxis: { anchor: "y2" },
        yaxis: { type: "log", domain: [0.36, 1], tickvals: ticks, ticktext: ticks.map(tidy),
          range: [Math.log10(low / margin), Math.log10(high * margin)] },
        yaxis2: { domain: [0, 0.26], range: [Math.min(1.08 * deepest, -0.001), 0],
          tickformat: ".0%", nticks: 5 },
        shapes: [{ yref: "y", y0: 1, y1: 1 }, { yref: "y2", y0: 0, y1: 0 }],
      }), options("wealth"));
  }

  function drawCosts() {
    const chart = byId("costs");
    const months = data.months.length > 1;
    return Plotly.react(chart,
      [...lines("cost", data.dates, "y", true), ...lines("turnover", data.months, "y2", false)],
      layout(narrow.matches ? 440 : 510, {
        titles: [["Share of the wealth lost to costs so far", 1],
          [months ? "Monthly turnover, over wealth" : "Turnover, over wealth", 0.42]],
        xaxis: { anchor: "y2" },
        yaxis: { domain: [0.56, 1], rangemode: "tozero", tickformat: ".0%", nticks: 5 },
        yaxis2: { domain: [0, 0.42], rangemode: "tozero", tickformat: ".0%", nticks: 5 },
      }), options("costs"));
  }

  // A legend is a table: a button for each strategy and its values where the pointer is.

  function read(id, index) {
    const table = document.querySelector(`table[data-legend="${id}"]`);
    const date = data.dates[index];
    // Turnover has a value for each month, not for each date.
    const month = data.months.findIndex((_, m) => m + 1 === data.months.length
      || data.months[m + 1] > date);
    table.querySelector("time").textContent = date;
    for (const cell of table.querySelectorAll("[data-value]")) {
      const key = cell.dataset.value;
      const values = data.strategies[Number(cell.dataset.strategy)][key];
      cell.textContent = FORMATS[key](values[key === "turnover" ? month : index]);
    }
  }

  function follow(id, dates, show, rest) {
    const chart = byId(id);
    const reach = (event) => {
      const point = event.points[0];
      const x = point.data.x[point.pointIndex];
      const index = dates.findIndex((date) => date >= x);
      show(index < 0 ? dates.length - 1 : index);
    };
    chart.on("plotly_hover", reach);
    chart.on("plotly_click", reach); // all that a tap causes
    chart.on("plotly_unhover", rest);
  }

  function toggle(index) {
    if (!hidden.delete(index)) hidden.add(index);
    for (const button of document.querySelectorAll(`button[data-strategy="${index}"]`)) {
      button.setAttribute("aria-pressed", String(!hidden.has(index)));
    }
    drawWealth();
    drawCosts();
  }

  // Weights ---------------------------------------------------------------------------------

  function drawWeights() {
    const series = data.weights.series[chosen];
    const traces = series.values.map((values, i) => {
      const cash = series.colours[i] === "cash";
      const area = {
        x: data.weights.dates, y: values, type: "scatter", mode: "lines", stackgroup: "weights",
        hoverinfo: "none", meta: i, line: { width: 0 },
        fillcolor: cash ? colour("wash") : colour(series.colours[i]),
      };
      if (cash) {
        area.fillpattern = { shape: "/", size: 7, solidity: 0.2, fgcolor: colour("muted"),
          bgcolor: colour("wash") };
      }
      return area;
    });
    return Plotly.react(byId("weights"), traces, layout(narrow.matches ? 350 : 510, {
      titles: [["Share of the wealth", 1]],
      yaxis: { range: [0, 1], tickformat: ".0%", nticks: 5, layer: "above traces" },
    }), options("weights"));
  }

  function listWeights() {
    const series = data.weights.series[chosen];
    const body = byId("weights-list");
    body.replaceChildren();
    for (let i = series.names.length - 1; i >= 0; i -= 1) { // as they are stacked
      const row = body.insertRow();
      const head = document.createElement("th");
      head.scope = "row";
      const patch = document.createElement("span");
      patch.className = series.colours[i] === "cash" ? "patch cash" : "patch";
      if (series.colours[i] !== "cash") {
        patch.style.background = series.colours[i].startsWith("#")
          ? series.colours[i] : `var(--${series.colours[i]})`;
      }
      head.append(patch, series.names[i]);
      row.append(head);
      row.insertCell().textContent = percent(series.average[i]);
      row.insertCell().className = "now";
    }
    readWeights(data.weights.dates.length - 1);
  }

  function readWeights(index) {
    const series = data.weights.series[chosen];
    byId("weights-date").textContent = data.weights.dates[index];
    const cells = byId("weights-list").querySelectorAll(".now");
    cells.forEach((cell, row) => {
      cell.textContent = percent(series.values[series.names.length - 1 - row][index]);
    });
  }

  // All together ----------------------------------------------------------------------------

  const charts = [drawWealth, drawWeights, drawCosts];
  const redraw = () => charts.forEach((draw) => draw());
  const atEnd = () => data.dates.length - 1;

  for (const button of document.querySelectorAll("button[data-strategy]")) {
    button.addEventListener("click", () => toggle(Number(button.dataset.strategy)));
  }
  byId("weights-strategy").addEventListener("change", (event) => {
    chosen = Number(event.target.value);
    listWeights();
    drawWeights();
  });
  byId("months-strategy").addEventListener("change", (event) => {
    for (const table of document.querySelectorAll("table[data-months]")) {
      table.hidden = table.dataset.months !== event.target.value;
    }
  });
  listWeights();
  document.documentElement.classList.add("drawn");
  redraw();
  follow("wealth", data.dates, (i) => read("wealth", i), () => read("wealth", atEnd()));
  follow("costs", data.dates, (i) => read("costs", i), () => read("costs", atEnd()));
  follow("weights", data.weights.dates, readWeights,
    () => readWeights(data.weights.dates.length - 1));
  byId("wealth").on("plotly_relayout", (event) => {
    // The height follows what is in view; a range of the height alone is our own answer.
    if (Object.keys(event).some((key) => key.startsWith("xaxis"))) drawWealth();
  });
  for (const query of [dark, narrow, coarse]) query.addEventListener("change", redraw);
  addEventListener("beforeprint", () => { printing = true; redraw(); });
  addEventListener("afterprint", () => { printing = false; redraw(); });
})();
