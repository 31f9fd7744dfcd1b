/* What the charts of a backtest's report share: numbers, colors, axes, and names beside them.
   Names that users give never reach plotly, which would read markup in them: the charts carry
   numbers only, and names stand in the page beside them. */
"use strict";
const tools = (() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const narrow = matchMedia("(max-width: 40rem)");
  const coarse = matchMedia("(pointer: coarse)");
  const state = { printing: false };

  const MARGIN = 44; // left of an axis, for its numbers
  const PRINTED = 380; // the most height of a chart on paper
  const TOP = 26, BOTTOM = 40; // above and below the plots of a chart
  const GAP = 36; // between two plots: half a number, a title, and half a number
  const MINUS = "\u2212";
  const SANS = getComputedStyle(document.documentElement).getPropertyValue("--sans").trim();
  const byId = (id) => document.getElementById(id);
  const last = (values) => values[values.length - 1];
  const color = (name) => (state.printing && name === "paper") ? "#ffffff" : data.themes[dark.matches && !state.printing ? "dark" : "light"][name] || name;
  const translucent = (hex, alpha) => hex + Math.round(255 * alpha).toString(16).padStart(2, "0");
  const dashes = (pattern) => pattern && pattern.split(" ").map((part) => part + "px").join(",");

  function number(value, digits) {
    if (value === null || value === undefined) return "–";
    const text = Math.abs(value).toFixed(digits).replace(/\B(?=(\d{3})+(?!\d))/g, ",");
    return (value < 0 && /[1-9]/.test(text) ? MINUS : "") + text;
  }
  const percent = (value, digits = 1) =>
    value === null || value === undefined ? "–" : number(100 * value, digits) + "%";
  const times = (value) => number(value, value >= 100 ? 0 : value >= 10 ? 1 : 2);
  const ratio = (value) => number(value, 2);

  // Axes ------------------------------------------------------------------------------------

  function layout(wanted, more) {
    const text = color("muted");
    const height = state.printing ? Math.min(wanted, PRINTED) : wanted;
    const upper = more.yaxis2 && [Math.max(more.yaxis.domain[0],
      more.yaxis2.domain[1] + GAP / (height - TOP - BOTTOM)), 1];
    return {
      height, width: state.printing ? 660 : undefined,
      paper_bgcolor: color("paper"), plot_bgcolor: color("paper"),
      font: { family: SANS, size: 12, color: text },
      margin: { l: MARGIN, r: 10, t: TOP, b: BOTTOM, ...more.margin },
      showlegend: false, hovermode: "x", hoverdistance: -1, spikedistance: -1,
      dragmode: coarse.matches ? false : "zoom", uirevision: "kept",
      xaxis: {
        type: "date", showgrid: false, linecolor: text, ticks: "outside", tickcolor: text,
        ticklen: 4, nticks: narrow.matches ? 5 : 9,
        // With their years below, months fit without being turned, which would cut them off.
        tickangle: 0, tickformatstops: [{ dtickrange: ["M1", "M6"], value: "%b\n%Y" }],
        showspikes: true, spikemode: "across", spikesnap: "hovered data", spikedash: "solid",
        spikethickness: 1, spikecolor: color("faint"), fixedrange: coarse.matches, ...more.xaxis,
      },
      ...Object.fromEntries(["yaxis", "yaxis2"].filter((name) => more[name]).map((name) => [name, {
        gridcolor: color("hairline"), zeroline: false, fixedrange: true, ...more[name],
        ...(upper && name === "yaxis" ? { domain: upper } : {}),
      }])),
      shapes: (more.shapes || []).map((shape) => ({
        type: "line", xref: "paper", x0: 0, x1: 1, layer: "below",
        line: { color: text, width: 1 }, ...shape,
      })),
      annotations: (more.titles || []).map(([title, y]) => ({
        text: title, x: 0, y, xref: "paper", yref: "paper", xanchor: "left", yanchor: "bottom",
        yshift: 9, xshift: -(more.margin?.l ?? MARGIN), showarrow: false, font: { size: 12.5, color: color("ink") },
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

  /** Room for names at the right of a chart: what the longest needs, up to a limit. */
  const pen = document.createElement("canvas").getContext("2d");
  function room(names) {
    const [size, most] = narrow.matches ? [0.68, 96] : [0.76, 150]; // in rem, as of .labels
    pen.font = `600 ${size * parseFloat(getComputedStyle(document.documentElement).fontSize)}px ${SANS}`;
    const widest = Math.max(...names.map((name) => pen.measureText(name).width), 30);
    return Math.min(Math.ceil(widest) + 12, most);
  }

  /** Puts names where lines end, in several lines if need be, moved apart where they would overlap. */
  function label(id, chart, axis, entries) {
    const place = byId(id);
    place.replaceChildren();
    const { _offset: top, _length: height } = chart._fullLayout[axis];
    const marks = entries.map((entry) => {
      const span = document.createElement("span");
      span.className = "end";
      span.textContent = entry.name;
      span.style.width = `${chart.layout.margin.r - 8}px`;
      span.style.color = color(entry.color);
      place.append(span);
      return { span, half: span.offsetHeight / 2, at: top + entry.at * height };
    }).sort((a, b) => a.at - b.at);
    let limit = -Infinity;
    for (const mark of marks) {
      mark.at = Math.max(mark.at, limit + mark.half);
      limit = mark.at + mark.half;
    }
    limit = top + height + (narrow.matches ? 13 : 14); // a line below the axis
    for (const mark of marks.toReversed()) {
      mark.at = Math.min(mark.at, limit - mark.half);
      limit = mark.at - mark.half;
      mark.span.style.top = `${mark.at}px`;
    }
  }

  return { data, dark, narrow, coarse, state, TOP, BOTTOM, byId, color, translucent, dashes,
    percent, times, ratio, layout, options, logTicks, tidy, inView, extent, room, label };
})();
