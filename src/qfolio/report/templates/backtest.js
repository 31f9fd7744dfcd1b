/* The lines of all strategies: wealth, drawdown, costs, rolling ratios; their legends and choices. */
"use strict";
(() => {
  const { data, dark, narrow, coarse, state, byId, color, translucent, dashes, percent,
    times, ratio, layout, options, logTicks, tidy, inView, extent, room, label } = tools;
  const hidden = new Set(data.hidden);
  const names = [...document.querySelectorAll("table[data-legend=wealth] button")]
    .map((button) => button.textContent.trim());
  const FORMATS = { wealth: times, drawdown: percent, cost: percent, turnover: percent,
    sharpe: ratio, beta: ratio };
  const shown = () => data.strategies.filter((_, index) => !hidden.has(index));

  // Lines of all strategies -----------------------------------------------------------------

  /** A line for each strategy, agents on top; a main one with the bands and marks of agents. */
  function lines(key, dates, axis, main) {
    const order = data.strategies.map((_, i) => i).reverse();
    return order.flatMap((index) => {
      const strategy = data.strategies[index];
      const ink = color(strategy.color);
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
        // Shapes tell agents apart where colors do not; each begins at another place.
        const count = narrow.matches ? 4 : 7;
        const places = Array.from({ length: count }, (_, k) =>
          Math.round((dates.length - 1) * (k + 0.35 + 0.3 * (index % 3)) / count));
        result.push({ ...base, mode: "markers", x: places.map((i) => dates[i]),
          y: places.map((i) => strategy[key][i]),
          marker: { symbol: strategy.symbol, size: 8, color: ink,
            line: { width: 1.5, color: color("paper") } } });
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
        margin: { r: room(names.filter((_, index) => !hidden.has(index))) },
        titles: [["Wealth, starting at 1 (log scale)", 1], ["Drawdown", 0.26]],
        xaxis: { anchor: "y2" },
        yaxis: { type: "log", domain: [0.36, 1], tickvals: ticks, ticktext: ticks.map(tidy),
          range: [Math.log10(low / margin), Math.log10(high * margin)] },
        yaxis2: { domain: [0, 0.26], range: [Math.min(1.08 * deepest, -0.001), 0],
          tickformat: "~%", nticks: 5 },
        shapes: [{ yref: "y", y0: 1, y1: 1 }, { yref: "y2", y0: 0, y1: 0 }],
      }), options("wealth")).then(() => nameEnds("wealth", "yaxis", "wealth", view, (value) =>
      Math.log10(value / (low / margin)) / Math.log10(high / low * margin ** 2)));
  }

  /** Names the lines of a chart where they leave the view; share: a value's height on the axis. */
  function nameEnds(id, axis, key, [, to], share) {
    const entries = data.strategies.map((strategy, index) => ({
      name: names[index], color: strategy.color, value: strategy[key][to - 1], index,
    })).filter((entry) => !hidden.has(entry.index) && entry.value !== null);
    label(`${id}-labels`, byId(id), axis,
      entries.map((entry) => ({ ...entry, at: 1 - Math.min(Math.max(share(entry.value), 0), 1) })));
  }

  /** The Sharpe ratio and the beta of the last year; drawn when the tear sheet is open. */
  function drawRolling() {
    const chart = byId("rolling");
    if (!chart || !byId("sheet").open) return undefined;
    const view = inView(chart, data.dates);
    const from = data.dates.findIndex((_, i) => data.strategies.some((s) => s.sharpe[i] !== null));
    const [low, high] = extent(shown().map((s) => s.sharpe), view) || [0, 1];
    const edge = 0.06 * (high - low) || 0.1;
    return Plotly.react(chart,
      [...lines("sharpe", data.dates, "y", false), ...lines("beta", data.dates, "y2", false)],
      layout(state.printing ? 290 : narrow.matches ? 440 : 470, {
        margin: { r: room(names.filter((_, index) => !hidden.has(index))) },
        titles: [["Sharpe ratio of the last year", 1], ["Beta of the last year", 0.36]],
        xaxis: { anchor: "y2", range: [data.dates[Math.max(from, 0)], data.dates[atEnd()]] },
        yaxis: { domain: [0.46, 1], range: [low - edge, high + edge], nticks: 6 },
        yaxis2: { domain: [0, 0.36], nticks: 5 },
        shapes: [{ yref: "y", y0: 0, y1: 0 }],
      }), options("rolling")).then(() => nameEnds("rolling", "yaxis", "sharpe", view,
      (value) => (value - low + edge) / (high - low + 2 * edge)));
  }

  function drawCosts() {
    const chart = byId("costs");
    const months = data.months.length > 1;
    return Plotly.react(chart,
      [...lines("cost", data.dates, "y", true), ...lines("turnover", data.months, "y2", false)],
      layout(state.printing ? 235 : narrow.matches ? 440 : 510, {
        titles: [["Share of the wealth lost to costs so far", 1],
          [months ? "Monthly turnover, over wealth" : "Turnover, over wealth", 0.42]],
        xaxis: { anchor: "y2" },
        yaxis: { domain: [0.56, 1], rangemode: "tozero", tickformat: "~%", nticks: 5 },
        yaxis2: { domain: [0, 0.42], rangemode: "tozero", tickformat: "~%", nticks: 5 },
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
    drawRolling();
  }

  // All together ----------------------------------------------------------------------------

  const redraw = () => [drawWealth, drawRolling, drawCosts].forEach((draw) => draw());
  const atEnd = () => data.dates.length - 1;

  /** Shows one of several alternatives, as chosen in a list. */
  function choose(list, attribute) {
    byId(list).addEventListener("change", (event) => {
      for (const part of document.querySelectorAll(`[data-${attribute}]`)) {
        part.hidden = part.dataset[attribute] !== event.target.value;
      }
    });
  }

  for (const button of document.querySelectorAll("button[data-strategy]")) {
    button.addEventListener("click", () => toggle(Number(button.dataset.strategy)));
  }
  for (const button of document.querySelectorAll("button.rest")) {
    button.addEventListener("click", () => {
      button.setAttribute("aria-expanded", "true");
      for (const row of button.parentElement.querySelectorAll("[data-rest]")) row.hidden = false;
    });
  }
  choose("months-strategy", "months");
  choose("sheet-strategy", "sheet");
  document.documentElement.classList.add("drawn");
  redraw();
  follow("wealth", data.dates, (i) => read("wealth", i), () => read("wealth", atEnd()));
  follow("costs", data.dates, (i) => read("costs", i), () => read("costs", atEnd()));
  byId("wealth").on("plotly_relayout", (event) => {
    // The height follows what is in view; a range of the height alone is our own answer.
    if (Object.keys(event).some((key) => key.startsWith("xaxis"))) drawWealth();
  });
  let followed = false; // printing may draw the chart before it is opened
  byId("sheet").addEventListener("toggle", () => {
    drawRolling();
    if (!followed && byId("rolling")?.data) {
      followed = true;
      follow("rolling", data.dates, (i) => read("rolling", i), () => read("rolling", atEnd()));
    }
  });
  for (const query of [dark, narrow, coarse]) query.addEventListener("change", redraw);
  addEventListener("resize", () => { drawWealth(); drawRolling(); });
  let opened = false;
  addEventListener("beforeprint", () => {
    state.printing = true;
    opened = byId("sheet").open;
    byId("sheet").open = true;
    redraw();
  });
  addEventListener("afterprint", () => {
    state.printing = false;
    byId("sheet").open = opened;
    redraw();
  });
})();
