// The board: asks the server again and again for what has changed, and draws it.
// What comes from a log is set as text, never as markup.
"use strict";

const EVERY = 700; // milliseconds between two questions
const COLORS = 6; // then they come again, dashed
const SHARES = ["growth", "active_growth", "low", "high", "volatility", "drawdown", "cost_drag", "regret"]; // results in percent
const STATES = ["running", "done", "stopped", "failed"];
const NAMES = { // what curves show, the most telling first
  "return": "Return in training", "greedy return": "Greedy return", "greedy regret": "Greedy regret",
  "growth": "Growth in training", "held-out growth": "Held-out growth", "loss": "Loss",
  "max_q": "Largest action value", "q": "Action value", "value_loss": "Loss of the critic",
  "explained_variance": "Explained variance", "overestimation": "Overestimation",
  "entropy": "Entropy of the policy", "kl": "KL divergence", "clip_fraction": "Clip fraction",
  "gradient_norm": "Gradient norm", "epsilon": "Exploration ε", "temperature": "Temperature",
  "turnover": "Turnover", "cost": "Cost", "cash": "Cash", "assets": "Effective number of assets",
  "distance": "Distance from the anchor",
};

const find = (id) => document.getElementById(id);
const runs = new Map(); // key → what the list says
const details = new Map(); // key → {version, jobs, results}
const items = new Map(); // key → its place in the list
let version = 0, reading = 0, searched = null, chosen = [], following = true, connected = true, hovered = null;

// Elements ------------------------------------------------------------------------------------

function element(name, properties = {}, ...children) {
  const made = document.createElement(name);
  Object.assign(made, properties);
  made.append(...children);
  return made;
}

function drawn(name, attributes = {}) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

function say(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

// Words ---------------------------------------------------------------------------------------

const THIN = "\u202f";
const LONG = 1e9; // seconds that are no time of a run

function number(x) {
  if (x === null || x === undefined || !Number.isFinite(x)) return "–";
  const size = Math.abs(x);
  let text;
  if (size >= 1e6) text = x.toExponential(2);
  else if (size >= 1000) text = Math.round(x).toString().replace(/\B(?=(\d{3})+$)/g, ",");
  else if (size >= 100) text = x.toFixed(1);
  else if (size >= 1 || size === 0) text = x.toFixed(2);
  else text = size < 1e-3 ? x.toExponential(1) : x.toPrecision(3);
  return text.replace("-", "−");
}

function result(name, x) {
  if (!SHARES.includes(name) || !Number.isFinite(x)) return number(x);
  if (Math.abs(x) >= 10) return `${number(100 * x)}%`;
  return `${(100 * x).toFixed(2)}%`.replace(/^-(?!0\.00%)/, "−").replace("-", "");
}

function labels(values) { // of the ticks of an axis, all in one unit
  const most = Math.max(...values.map(Math.abs));
  const power = most >= 1e9 || most > 0 && most < 1e-4 ? Math.floor(Math.log10(most)) : most >= 1e6 ? 6 : most >= 1e4 ? 3 : 0;
  const unit = { 0: "", 3: "k", 6: "M" }[power] ?? `e${power < 0 ? "" : "+"}${power}`;
  const digits = (x) => String(+(x / 10 ** power).toPrecision(12)); // without the last ones of sums
  return values.map((x) => (x === 0 ? "0" : digits(x) + unit).replaceAll("-", "−"));
}

function span(seconds) {
  if (seconds === null || !(Math.abs(seconds) < LONG)) return "–";
  const s = Math.round(Math.max(seconds, 0));
  if (s < 90) return `${s}${THIN}s`;
  const m = Math.round(s / 60);
  if (m < 90) return `${m}${THIN}min`;
  if (m < 2880) return `${Math.floor(m / 60)}${THIN}h ${m % 60}${THIN}min`;
  return `${Math.round(s / 86400)} days`;
}

function ago(time) { // empty if that is not known
  const seconds = Date.now() / 1000 - time;
  return Math.abs(seconds) < LONG ? `${span(seconds)} ago` : "";
}

const percent = (x) => `${Math.floor(100 * x)}%`;
const plural = (count, noun) => `${number(count).replace(/[.].*/, "")} ${noun}${count === 1 ? "" : "s"}`;
const tail = (name) => name.split(":").pop();

function what(run) {
  const seeds = run.seeds ? plural(run.seeds, "seed") : "";
  return [run.kind, run.agents.map(tail).join(", "), run.task, seeds].filter(Boolean).join(" · ");
}

// The list ------------------------------------------------------------------------------------

function item(run) {
  let place = items.get(run.key);
  if (!place) {
    place = element("li");
    const pick = element("button", { className: "pick", title: "Compare" }, element("span"));
    const open = element("button", { className: "item" });
    const spark = drawn("svg", { viewBox: "0 0 60 16", preserveAspectRatio: "none", "aria-hidden": "true" });
    spark.append(drawn("path"));
    open.append(element("span", { className: "name" }), spark, element("span", { className: "what" }),
      element("span", { className: "when" }), element("span", { className: "bar" }, element("i")));
    pick.addEventListener("click", () => choose(chosen.includes(run.key)
      ? chosen.filter((key) => key !== run.key) : [...chosen, run.key]));
    open.addEventListener("click", (event) => choose(event.ctrlKey || event.metaKey
      ? [...new Set([...chosen, run.key])] : [run.key]));
    place.append(pick, open);
    items.set(run.key, place);
  }
  const get = (name) => place.querySelector(name);
  say(get(".name"), run.name);
  get(".name").title = run.name;
  say(get(".what"), what(run));
  get(".pick").setAttribute("aria-label", `Compare ${run.name}`);
  get("i").style.transform = `scaleX(${run.share ?? 0})`;
  get("path").setAttribute("d", line(run.spark));
  return place;
}

function line(values) {
  if (values.length < 2) return "";
  const low = Math.min(...values), high = Math.max(...values);
  const y = (v) => (15 - 14 * (v - low) / (high - low || 1)).toFixed(1);
  return "M" + values.map((v, i) => `${(60 * i / (values.length - 1)).toFixed(1)},${y(v)}`).join("L");
}

function list() {
  const wanted = find("filter").value.toLowerCase().split(/\s+/).filter(Boolean);
  const sorted = [...runs.values()].sort((a, b) =>
    (b.state === "running") - (a.state === "running") || b.begun - a.begun || (a.name < b.name ? -1 : 1));
  const shown = new Set(sorted.filter((run) => {
    const text = `${run.name} ${what(run)} ${run.state}`.toLowerCase();
    return wanted.every((word) => text.includes(word));
  }));
  sorted.forEach((run, i) => {
    const place = items.get(run.key), color = chosen.indexOf(run.key);
    place.hidden = !shown.has(run);
    place.className = `${run.state}${color < 0 ? "" : " chosen"}`;
    place.style.setProperty("--line", color < 0 ? "" : `var(--agent-${color % COLORS + 1})`);
    place.querySelector(".pick").setAttribute("aria-pressed", color >= 0);
    const when = run.state === "running" ? run.share !== null && percent(run.share) : run.state === "done" && ago(run.last);
    say(place.querySelector(".when"), when || run.state);
    if (find("runs").children[i] !== place) find("runs").insertBefore(place, find("runs").children[i] || null);
  });
  const counts = STATES.map((state) => [state, [...shown].filter((run) => run.state === state).length]);
  const text = [...counts, ["being read", reading]].filter(([, n]) => n).map(([state, n]) => `${n} ${state}`);
  if (shown.size < sorted.length) text.unshift(`${shown.size} of ${plural(sorted.length, "run")}`);
  if (searched) text.push(`only the nearest ${plural(searched, "folder")} are searched`);
  say(find("counts"), connected ? text.join(" · ") || "No runs yet" : "The board’s server has stopped.");
  find("unmatched").hidden = shown.size > 0 || !sorted.length;
  const running = sorted.filter((run) => run.state === "running").length;
  document.title = running ? `${running} running · qfolio` : "qfolio board";
  find("none").hidden = sorted.length + reading > 0;
  if (following && sorted.length && chosen[0] !== sorted[0].key) {
    chosen = [sorted[0].key];
    draw();
    list();
  }
}

function choose(keys) {
  following = false;
  chosen = keys;
  for (const key of details.keys()) if (!keys.includes(key)) details.delete(key);
  list();
  draw();
  look();
}

// What is chosen ------------------------------------------------------------------------------

function agentOf(run, job) { // of runs in which an agent has many jobs, folds and tables
  const parts = job.name.split("/");
  return run.kind === "backtest" ? parts[0] : run.kind === "study" ? parts.at(-2) : null;
}

const apart = (run) => run.kind === "run" || run.kind === "comparison"; // whose seeds may be jobs

function nameOf(run, job) { // of the group of jobs that are drawn alike
  if (apart(run)) return job.name.replace(/\/\d+$/, "");
  return agentOf(run, job) ?? job.name;
}

function groups() { // a run has one color among several; alone, each of its groups has one
  const found = [], used = {};
  for (const key of chosen) {
    const run = runs.get(key), detail = details.get(key);
    if (!run || !detail) continue;
    const byName = new Map();
    for (const job of detail.jobs.values()) {
      const name = nameOf(run, job);
      if (!byName.has(name)) byName.set(name, []);
      byName.get(name).push(job);
    }
    for (const [name, jobs] of byName) {
      const label = chosen.length === 1 ? name || run.agents.map(tail).join(", ")
        : byName.size === 1 ? run.name : [run.name, name].filter(Boolean).join(" · ");
      const color = (chosen.length === 1 ? found.length : chosen.indexOf(key)) % COLORS + 1;
      const nth = used[color] = (used[color] ?? -1) + 1; // of those in its color: a dash, and dots
      found.push({ run, name, jobs, agent: agentOf(run, jobs[0]) ?? "", label, color: `var(--agent-${color})`,
        dash: nth ? "7 4" + " .5 4".repeat(nth - 1) : "" });
    }
  }
  return found;
}

const stateOf = (run, job) => job.state === "running" && run.state !== "running" ? "stopped" : job.state;

function draw() {
  const shown = chosen.map((key) => runs.get(key)).filter(Boolean);
  find("shown").hidden = !shown.length;
  if (!shown.length) return;
  const found = groups(), single = shown.length === 1 ? shown[0] : null;
  header(shown, single);
  matrix(single, found);
  legend(found);
  charts(found);
  workers(shown);
  results(shown);
}

function header(shown, single) {
  const over = single ? [single.kind, single.task, single.agents.map(tail).join(", ")] : ["comparison of runs"];
  find("over").replaceChildren(...over.filter(Boolean).map((text) => element("span", { textContent: text })));
  say(find("title"), single ? single.name : `${shown.length} runs side by side`);
  const lede = find("lede");
  const running = shown.filter((run) => run.state === "running");
  const facts = [];
  if (single) {
    const done = single.state === "done", begun = single.begun;
    const until = single.state === "running" ? Date.now() / 1000 : single.last;
    const jobs = Object.values(single.jobs).reduce((a, b) => a + b, 0);
    const detail = details.get(single.key);
    const left = detail ? remaining(single, detail) : null;
    const text = { running: "Running", done: "Done", stopped: "Stopped", failed: "Failed" }[single.state];
    const when = single.state === "running" ? "" : ago(single.last);
    const also = single.error ? `: ${single.error}` : single.last === null ? ". Its log says nothing that can be read."
      : `${when && " "}${when}.`;
    const words = [element("span", { textContent: text + also, className: single.error ? "bad" : "" })];
    if (single.report) {
      words.push(" ", element("a", { textContent: "Open the report", target: "_blank", rel: "noopener",
        href: `/reports/${single.key}/report.html` }), ".");
    }
    const said = [single.key, text, also, single.report].join(" ");
    if (lede.dataset.said !== said) lede.replaceChildren(...words);
    lede.dataset.said = said;
    if (single.share !== null) facts.push(["done", percent(single.share)]);
    if (begun !== null) facts.push([done ? "took" : "so far", span(until - begun - single.paused)]);
    if (single.state === "running") facts.push(["left", span(left)], ["steps a second", single.rate ? number(Math.round(single.rate)) : "–"]);
    if (single.seeds) facts.push(["seeds", String(single.seeds)]);
    if (jobs > 1) facts.push(["jobs", `${single.jobs.done || 0} of ${jobs}`]);
    if (single.workers) facts.push(["workers", String(single.workers)]);
  } else {
    lede.dataset.said = "";
    say(lede, running.length ? `${running.length} of them ${running.length > 1 ? "are" : "is"} running.` : "None of them is running.");
  }
  const place = find("facts");
  while (place.children.length > facts.length) place.lastChild.remove();
  facts.forEach(([name, value], i) => {
    const pair = place.children[i] || place.appendChild(element("div", {}, element("dt"), element("dd")));
    say(pair.children[0], name);
    say(pair.children[1], value);
  });
}

function remaining(run, detail) { // jobs say what is left of them; others take as long as they did
  const jobs = [...detail.jobs.values()];
  if (jobs.length === 1) return jobs[0].left;
  const spent = Date.now() / 1000 - run.begun - run.paused;
  return run.share > .01 ? spent * (1 / run.share - 1) : null;
}

function matrix(single, found) {
  const jobs = single ? found.flatMap((group) => group.jobs) : [];
  find("jobs").hidden = jobs.length < 2;
  if (jobs.length < 2) return;
  const place = find("matrix"), rows = found.length > 12 ? [{ name: "", jobs }] : found;
  while (place.children.length > 2 * rows.length) place.lastChild.remove();
  rows.forEach((group, i) => {
    if (!place.children[2 * i]) place.append(element("span"), element("div", { className: "cells" }));
    say(place.children[2 * i], group.name);
    const cells = place.children[2 * i + 1];
    while (cells.children.length > group.jobs.length) cells.lastChild.remove();
    group.jobs.forEach((job, j) => {
      const cell = cells.children[j] || cells.appendChild(element("div", { className: "cell" }, element("i")));
      const state = stateOf(single, job);
      cell.className = `cell ${state}`;
      cell.title = [job.name, state, state === "running" ? percent(job.share) : "", job.worker].filter(Boolean).join(" · ");
      cell.firstChild.style.transform = `scaleY(${job.share})`;
    });
  });
}

function stroke(node, group) {
  node.style.stroke = group.color;
  node.style.strokeDasharray = group.dash;
  return node;
}

function legend(found) {
  const text = found.map((group) => group.label + group.color + group.dash).join("\n");
  const place = find("legend");
  place.hidden = found.length < 2 && chosen.length < 2;
  if (place.dataset.said === text) return;
  place.dataset.said = text;
  place.replaceChildren(...found.map((group) => {
    const mark = drawn("svg", { viewBox: "0 0 36 8" });
    mark.append(stroke(drawn("path", { d: "M1,4H35", "stroke-width": 2.4 }), group));
    return element("li", {}, mark, element("span", { textContent: group.label }));
  }));
}

function workers(shown) {
  const rows = [];
  for (const run of shown) {
    for (const job of details.get(run.key)?.jobs.values() || []) {
      if (stateOf(run, job) === "running" && job.worker) {
        rows.push([job.worker, job.name, job.rate === null ? "–" : number(Math.round(job.rate)), percent(job.share), span(job.left)]);
      }
    }
  }
  find("workers").hidden = !rows.length;
  rows.sort((a, b) => (a[0] < b[0] ? -1 : 1));
  table(find("workers-rows"), rows, "td");
}

function results(shown) {
  const rows = [], columns = [];
  for (const run of shown) {
    for (const [name, values] of Object.entries(details.get(run.key)?.results || {})) {
      for (const key of Object.keys(values)) if (!columns.includes(key)) columns.push(key);
      rows.push([shown.length > 1 ? `${run.name} · ${name}` : name, values]);
    }
  }
  find("results").hidden = !rows.length;
  table(find("results-head"), [["", ...columns.map((key) => key.replaceAll("_", " "))]], "th");
  table(find("results-rows"), rows.map(([name, values]) => [name, ...columns.map((key) => result(key, values[key]))]), "td");
}

function table(body, rows, kind) {
  const text = JSON.stringify(rows);
  if (body.dataset.said === text) return;
  body.dataset.said = text;
  body.replaceChildren(...rows.map((row) =>
    element("tr", {}, ...row.map((cell) => element(kind, { textContent: cell })))));
}

// Curves --------------------------------------------------------------------------------------

const LEFT = 46, RIGHT = 8, TOP = 12, BOTTOM = 22, HEIGHT = 208;
const pen = document.createElement("canvas").getContext("2d"); // measures labels

function linesOf(group, name) {
  const known = group.jobs.filter((job) => Object.hasOwn(job.curves, name) && job.curves[name].length);
  const whole = apart(group.run) && known.find((job) => job.name === group.name); // after it had been divided
  const jobs = whole ? [whole] : known, alone = Boolean(whole) || group.jobs.length === 1;
  const lines = jobs.map((job) => ({
    group, job, points: job.curves[name], alone, band: alone && job.members > 1, now: stateOf(group.run, job) === "running",
  }));
  if (!apart(group.run) || lines.length < 2) return lines;
  return [{ group, points: together(jobs, name), alone: true, band: true, now: lines.some((one) => one.now) }];
}

function together(jobs, name) { // the curve of seeds that are trained apart, at the steps of the furthest
  const curves = jobs.map((job) => job.curves[name]);
  const furthest = curves.reduce((a, b) => (b.at(-1)[0] > a.at(-1)[0] ? b : a));
  return furthest.map(([step]) => {
    const there = jobs.filter((job, i) => job.state === "done" || curves[i].at(-1)[0] >= step);
    const at = there.map((job) => between(job.curves[name], step));
    const seeds = there.map((job) => job.members || 1), all = seeds.reduce((sum, count) => sum + count, 0);
    return [step, at.reduce((sum, p, i) => sum + seeds[i] * p[1], 0) / all,
      Math.min(...at.map((p) => p[2])), Math.max(...at.map((p) => p[3]))];
  });
}

function between(points, step) { // on the straight line between two points; the last one goes on
  const [before, after] = around(points, step);
  const share = Math.max(0, Math.min(1, (step - before[0]) / (after[0] - before[0] || 1)));
  return before.map((v, k) => v + share * (after[k] - v));
}

function charts(found) { // agents of a backtest differ in losses and steps: each has its own charts
  const agents = [...new Set(found.map((group) => group.agent))], wanted = new Map();
  const order = Object.keys(NAMES), place = find("charts");
  const rank = (name) => (order.includes(name) ? order.indexOf(name) : order.length);
  for (const agent of agents) {
    const groups = found.filter((group) => group.agent === agent);
    const known = (job) => Object.keys(job.curves).filter((name) => job.curves[name].length);
    const metrics = new Set(groups.flatMap((group) => group.jobs.flatMap(known)));
    for (const name of [...metrics].sort((a, b) => rank(a) - rank(b) || (a < b ? -1 : 1))) {
      wanted.set(`${agent}\n${name}`, { name, groups, of: agents.length > 1 ? agent : "" });
    }
  }
  find("curves").hidden = !wanted.size;
  for (const old of [...place.children]) if (!wanted.has(old.dataset.id)) old.remove();
  [...wanted].forEach(([id, { name, groups, of }], i) => {
    let chart = [...place.children].find((old) => old.dataset.id === id);
    if (!chart) {
      chart = element("div", { className: "chart" }, element("h3", {}, element("span"), element("output")));
      chart.dataset.id = id;
      chart.append(drawn("svg", { role: "img" }), element("div", { className: "tip", hidden: true }));
      const svg = chart.querySelector("svg");
      svg.addEventListener("pointermove", (event) => { hovered = { id, x: event.offsetX }; draw(); });
      svg.addEventListener("pointerleave", () => { hovered = null; draw(); });
    }
    if (place.children[i] !== chart) place.insertBefore(chart, place.children[i] || null);
    plot(chart, name, groups, of);
  });
}

function plot(chart, name, found, of) {
  const svg = chart.querySelector("svg"), width = svg.clientWidth || 340;
  const shown = Object.hasOwn(NAMES, name) ? NAMES[name] : name.replaceAll("_", " ").replace(/^./, (c) => c.toUpperCase());
  const title = [shown, of].filter(Boolean).join(" · ");
  say(chart.querySelector("h3 span"), title);
  svg.setAttribute("viewBox", `0 0 ${width} ${HEIGHT}`);
  svg.setAttribute("aria-label", title);
  const lines = found.flatMap((group) => linesOf(group, name));
  const points = lines.flatMap((one) => one.points);
  const steps = extent([0, ...points.map((p) => p[0])]), values = range(points.map((p) => p[1]));
  const across = ticks(steps, width > 420 ? 5 : 4), up = ticks(values, 4), said = labels(up);
  pen.font = `11px ${getComputedStyle(svg).fontFamily}`;
  const wide = (text) => pen.measureText(text).width;
  const left = Math.max(LEFT, ...said.map((text) => wide(text) + 8));
  const x = (v) => left + (width - left - RIGHT) * (v - steps[0]) / (steps[1] - steps[0] || 1);
  const y = (v) => HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * (Math.max(values[0], Math.min(values[1], v)) - values[0]) / (values[1] - values[0]);
  const parts = [];
  for (const [i, tick] of up.entries()) {
    parts.push(drawn("line", { class: "grid", x1: left, x2: width - RIGHT, y1: y(tick), y2: y(tick) }));
    const text = drawn("text", { x: left - 8, y: y(tick) + 4, "text-anchor": "end" });
    text.textContent = said[i];
    parts.push(text);
  }
  for (const [i, label] of labels(across).entries()) {
    if (x(across[i]) + wide(label) / 2 > width + RIGHT) continue; // would hang out
    const text = drawn("text", { x: x(across[i]), y: HEIGHT - 4, "text-anchor": "middle" });
    text.textContent = label;
    parts.push(text);
  }
  for (const one of lines) {
    const at = (k) => one.points.map((p) => `${x(p[0]).toFixed(1)},${y(p[k]).toFixed(1)}`);
    if (one.band && one.points.length > 1) {
      const band = drawn("path", { class: "band", d: `M${at(3).join("L")}L${at(2).reverse().join("L")}Z` });
      band.style.fill = one.group.color;
      parts.push(band);
    }
  }
  for (const one of lines.sort((a, b) => a.now - b.now)) {
    const d = one.points.length > 1 ? "M" + one.points.map((p) => `${x(p[0]).toFixed(1)},${y(p[1]).toFixed(1)}`).join("L")
      : `M${x(one.points[0][0]) - 2},${y(one.points[0][1])}h4`;
    parts.push(stroke(drawn("path", { d, class: `line${one.alone ? "" : " thin"}${one.now ? " now" : ""}` }), one.group));
  }
  const last = lines.filter((one) => one.alone);
  say(chart.querySelector("output"), last.length === 1 ? number(last[0].points.at(-1)[1]) : "");
  tip(chart, lines, steps, left, width, parts, x);
  svg.replaceChildren(...parts);
}

function tip(chart, lines, steps, left, width, parts, x) {
  const place = chart.querySelector(".tip");
  place.hidden = hovered?.id !== chart.dataset.id || !lines.length;
  if (place.hidden) return;
  const step = steps[0] + (steps[1] - steps[0]) * Math.max(0, Math.min(1, (hovered.x - left) / (width - left - RIGHT)));
  parts.push(drawn("line", { class: "cursor", x1: x(step), x2: x(step), y1: TOP, y2: HEIGHT - BOTTOM }));
  place.classList.toggle("left", hovered.x > width / 2);
  const near = lines.map((one) => ({ one, point: nearest(one.points, step) }));
  near.sort((a, b) => b.point[1] - a.point[1]);
  const label = (one) => (one.alone ? one.group.label : `${chosen.length > 1 ? one.group.run.name + " · " : ""}${one.job.name}`);
  place.replaceChildren(element("div", {}, element("span", { textContent: `step ${number(Math.round(step))}` })),
    ...near.slice(0, 8).map(({ one, point }) => {
      const row = element("div", {}, element("span", { textContent: label(one) }), element("span", { textContent: number(point[1]) }));
      row.style.color = one.group.color;
      return row;
    }), ...(near.length > 8 ? [element("div", { textContent: `and ${near.length - 8} more` })] : []));
}

function around(points, step) { // the points before and after a step
  let low = 0, high = points.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (points[middle][0] < step) low = middle; else high = middle;
  }
  return [points[low], points[high]];
}

function nearest(points, step) {
  const [before, after] = around(points, step);
  return step - before[0] < after[0] - step ? before : after;
}

function extent(values) {
  let low = Infinity, high = -Infinity;
  for (const v of values) { if (v < low) low = v; if (v > high) high = v; }
  return low <= high ? [low, high] : [0, 1];
}

function range(values) { // without the most extreme hundredth, which would flatten all else
  const sorted = Float64Array.from(values).sort();
  const cut = sorted.length >= 200 ? Math.floor(sorted.length / 100) : 0;
  let [low, high] = extent([sorted[cut], sorted[sorted.length - 1 - cut]].filter(Number.isFinite));
  const size = Math.max(Math.abs(low), Math.abs(high)); // a number is rounded to 7 digits or to 16
  if (high - low <= 1e-6 * size) { const pad = size / 10 || 1; low -= pad; high += pad; }
  const pad = (high - low) * .04;
  return [low - pad, high + pad];
}

function ticks([low, high], count) {
  const raw = (high - low) / count || 1, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].find((m) => m * power >= raw) * power;
  const found = [];
  for (let t = Math.ceil(low / step) * step; t <= high + step * 1e-9 && found.length < 12; t += step) found.push(Math.abs(t) < step * 1e-9 ? 0 : t);
  return found;
}

// Asking --------------------------------------------------------------------------------------

async function ask(path) {
  const answer = await fetch(path, { cache: "no-store" }).catch(() => null);
  return answer?.ok ? answer.json().catch(() => null) : null;
}

async function look() {
  const news = await ask(`/runs?since=${version}`);
  connected = Boolean(news);
  if (!news) { list(); return; }
  if (news.version < version) { // the server is another one
    version = 0;
    runs.clear(); details.clear(); items.clear();
    find("runs").replaceChildren();
    chosen = []; following = true;
    return;
  }
  ({ version, reading, searched } = news);
  say(find("root"), news.root);
  for (const run of news.runs) { runs.set(run.key, run); item(run); }
  const keys = new Set(news.keys);
  for (const key of [...runs.keys()]) {
    if (!keys.has(key)) { runs.delete(key); items.get(key).remove(); items.delete(key); details.delete(key); }
  }
  const gone = chosen.some((key) => !keys.has(key));
  chosen = chosen.filter((key) => keys.has(key));
  list();
  const told = await Promise.all(chosen.map(refresh));
  if (gone || told.some(Boolean) || news.runs.some((run) => chosen.includes(run.key))) draw();
  else if (chosen.some((key) => runs.get(key)?.state === "running")) header(chosen.map((key) => runs.get(key)).filter(Boolean), chosen.length === 1 ? runs.get(chosen[0]) : null);
}

async function refresh(key) {
  const known = details.get(key) || { version: 0, jobs: new Map(), results: {} };
  const news = await ask(`/runs/${key}?since=${known.version}`);
  if (!news || !chosen.includes(key)) return false;
  details.set(key, known);
  known.version = news.version;
  const names = new Set(news.names), gone = [...known.jobs.keys()].filter((name) => !names.has(name));
  for (const name of gone) known.jobs.delete(name); // of work that was divided otherwise, or of another run
  known.results = news.results;
  for (const job of news.jobs) known.jobs.set(job.name, job);
  return news.jobs.length + gone.length > 0;
}

async function forever() {
  try { await look(); } finally { setTimeout(forever, document.hidden ? 4 * EVERY : EVERY); }
}

find("filter").addEventListener("input", list);
addEventListener("resize", draw);
forever();
