
"use strict";
/* The table and the panels of the overview. Whatever the data say becomes text, never markup. */
(() => {
  const at = (id) => document.getElementById(id);
  const data = JSON.parse(at("data").textContent);
  const { columns, recordings, links, series } = data;
  const column = new Map(columns.map((one) => [one.name, one]));
  const MARGIN = 8; // rows that are made beyond what is seen, so that scrolling finds them there

  // ---- numbers and texts -------------------------------------------------------------------------------------------

  const raised = (exponent) => String(exponent).replace(/[-\d]/g, (c) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(c)]);

  function number(value, digits = 4) {
    if (value === null || !Number.isFinite(value)) return "–";
    const [mantissa, exponent] = String(Number(value.toPrecision(digits))).replace("-", "−").split("e");
    return exponent ? `${mantissa}×10${raised(Number(exponent))}` : mantissa;
  }

  function shown(one, row) {
    const value = one.values[row];
    if (value === null || value === undefined) return "–";
    if (one.kind === "text") return value;
    if (one.decimals === null) return number(value);
    const large = Math.abs(value) >= 1e9;
    return large ? number(value) : value.toFixed(one.decimals).replace("-", "−");
  }

  function element(name, text = "", className = "") {
    const made = document.createElement(name);
    made.textContent = text;
    if (className) made.className = className;
    return made;
  }

  function named(row) {
    if (links[row] === null) return document.createTextNode(recordings[row]);
    const link = element("a", recordings[row]);
    link.setAttribute("href", links[row]);
    return link;
  }

  const failed = (row) => column.get("status").values[row] !== "ok";

  // ---- lists of which only what is seen is in the page -------------------------------------------------------------

  /* `make(k)` gives the element of row k; all rows are equally high. */
  function seenRows(viewport, list, space, make) {
    const rows = new Map();
    const above = space(), below = space();
    let count = 0, height = 0;
    list.append(above.whole, below.whole);

    function draw() {
      if (!count) return;
      const first = Math.max(0, Math.floor(viewport.scrollTop / height) - MARGIN);
      const last = Math.min(count, Math.ceil((viewport.scrollTop + viewport.clientHeight) / height) + MARGIN);
      for (const [k, row] of rows) {
        if (k >= first && k < last) continue;
        if (row.contains(document.activeElement)) viewport.focus({ preventScroll: true });
        row.remove();
        rows.delete(k);
      }
      let next = above.whole.nextSibling;
      for (let k = first; k < last; k++) {
        if (!rows.has(k)) {
          rows.set(k, make(k));
          list.insertBefore(rows.get(k), next);
        }
        next = rows.get(k).nextSibling;
      }
      above.height(first * height);
      below.height((count - last) * height);
    }

    function show(n) {
      count = n;
      for (const row of rows.values()) row.remove();
      rows.clear();
      above.height(0);
      below.height(0);
      if (!count) return;
      const probe = make(0);
      list.insertBefore(probe, below.whole);
      height = probe.getBoundingClientRect().height || 30;
      probe.remove();
      below.height(count * height);
      draw();
    }

    let waiting = false;
    viewport.addEventListener("scroll", () => {
      if (waiting) return;
      waiting = true;
      requestAnimationFrame(() => { waiting = false; draw(); });
    }, { passive: true });
    return { show, draw };
  }

  // ---- which rows, in which order ----------------------------------------------------------------------------------

  const state = { sort: null, descending: false, text: "", chosen: new Map() };
  const collator = new Intl.Collator(undefined, { numeric: true, sensitivity: "base" });
  let order = [];
  let haystacks = null;

  function haystack(row) {
    haystacks ??= recordings.map((_, k) =>
      columns.filter((one) => one.kind === "text").map((one) => one.values[k] ?? "").join("\n").toLowerCase());
    return haystacks[row];
  }

  function select() {
    const words = state.text.toLowerCase().split(/\s+/).filter(Boolean);
    const tests = [...state.chosen].map(([name, text]) => [column.get(name), text]);
    order = [];
    for (let row = 0; row < recordings.length; row++) {
      if (tests.every(([one, text]) => shown(one, row) === text) &&
          words.every((word) => haystack(row).includes(word))) order.push(row);
    }
    const by = column.get(state.sort);
    if (!by) return;
    const sign = state.descending ? -1 : 1;
    const values = by.values;
    const compare = by.kind === "text" ? collator.compare : (a, b) => a - b;
    order.sort((a, b) => {
      const none = (values[a] === null) - (values[b] === null); // what has no value comes last, either way
      return none || (values[a] === null ? 0 : sign * compare(values[a], values[b])) || a - b;
    });
  }

  // ---- the state in the address, so that a view can be shared ------------------------------------------------------

  function readAddress() {
    const asked = new URLSearchParams(location.hash.slice(1));
    const sort = asked.get("sort") ?? "";
    const name = sort.replace(/^-/, "");
    state.sort = column.has(sort) ? sort : column.has(name) ? name : null;
    state.descending = state.sort !== null && state.sort !== sort;
    state.text = asked.get("text") ?? "";
    state.chosen.clear();
    for (const [key, text] of asked) {
      const of = column.get(key.slice(5));
      if (key.startsWith("only.") && of?.choices) state.chosen.set(of.name, text);
    }
  }

  function writeAddress() {
    const asked = new URLSearchParams();
    if (state.sort) asked.set("sort", (state.descending ? "-" : "") + state.sort);
    if (state.text) asked.set("text", state.text);
    for (const [name, text] of state.chosen) asked.set(`only.${name}`, text);
    history.replaceState(null, "", `#${asked}`);
  }

  // ---- the table ---------------------------------------------------------------------------------------------------

  const table = at("table");
  const heads = table.querySelector("thead tr");

  function width(one) {
    let longest = 0;
    const step = Math.max(1, Math.floor(recordings.length / 500)); // a sample is enough: longer texts are cut
    for (let row = 0; row < recordings.length; row += step) longest = Math.max(longest, shown(one, row).length);
    const word = Math.max(...`${one.label} ${one.unit}`.split(" ").map((part) => part.length));
    return Math.max(Math.min(longest, 26), word, 5) + 3;
  }

  function makeHeads() {
    let total = 0;
    for (const one of columns) {
      const wide = width(one);
      total += wide;
      const group = document.createElement("col");
      group.style.width = one.name === "recording" ? `min(${wide}ch, 45vw)` : `${wide}ch`; // it stays when the rest scrolls
      table.querySelector("colgroup").append(group);
      const head = element("th", "", one.kind === "text" ? "" : "number");
      head.scope = "col";
      const button = element("button", one.label);
      button.type = "button";
      button.append(element("small", one.unit));
      const arrow = element("span", "");
      arrow.setAttribute("aria-hidden", "true");
      button.insertBefore(arrow, button.lastChild);
      button.addEventListener("click", () => {
        state.descending = state.sort === one.name && !state.descending;
        state.sort = one.name;
        changed();
      });
      head.append(button);
      heads.append(head);
      one.head = { head, arrow };
    }
    table.firstElementChild.style.minWidth = `${total}ch`;
    table.firstElementChild.setAttribute("aria-colcount", columns.length);
  }

  function markHeads() {
    for (const one of columns) {
      const sorted = state.sort === one.name;
      one.head.arrow.textContent = sorted ? (state.descending ? " ▼" : " ▲") : "";
      if (sorted) one.head.head.setAttribute("aria-sort", state.descending ? "descending" : "ascending");
      else one.head.head.removeAttribute("aria-sort");
    }
  }

  function makeRow(k) {
    const row = order[k];
    const line = element("tr", "", failed(row) ? "failed" : "");
    line.setAttribute("aria-rowindex", k + 2);
    columns.forEach((one, j) => {
      const cell = element(j ? "td" : "th", "", one.kind === "text" ? "" : "number");
      if (j) cell.textContent = shown(one, row);
      else { cell.scope = "row"; cell.append(named(row)); }
      if (cell.textContent.length > 20) cell.title = cell.textContent;
      line.append(cell);
    });
    return line;
  }

  function tableSpace() {
    const whole = element("tr", "", "space");
    const cell = element("td");
    whole.setAttribute("aria-hidden", "true");
    cell.colSpan = columns.length;
    whole.append(cell);
    return { whole, height: (pixels) => { cell.style.height = `${pixels}px`; whole.hidden = !pixels; } };
  }

  // ---- the panels --------------------------------------------------------------------------------------------------

  const panels = at("panels");
  const WIDTH = 230, HEIGHT = 115, LEFT = 34, RIGHT = 6, TOP = 7, BOTTOM = 17;
  const drawn = (name, about) => {
    const made = document.createElementNS(at("drawing").namespaceURI, name);
    for (const [key, value] of Object.entries(about)) made.setAttribute(key, value);
    return made;
  };
  let packed = null, starts = null;

  const triples = (points) => Math.ceil((6 * points + Math.ceil(points / 8)) / 3);

  /* Times, values and trust of one recording: two, four bytes and one bit per point. */
  function unpack(row) {
    if (packed === null) {
      packed = at("series").textContent;
      starts = [0];
      for (const count of series.counts) starts.push(starts.at(-1) + (count ? 4 * triples(count) : 0));
    }
    const n = series.counts[row];
    const text = atob(packed.slice(starts[row], starts[row + 1]));
    const bytes = new DataView(Uint8Array.from(text, (c) => c.charCodeAt(0)).buffer);
    const [begin, end] = series.spans[row];
    const points = [];
    for (let k = 0; k < n; k++) {
      points.push({
        time: begin + (end - begin) * bytes.getUint16(2 * k, true) / 65535,
        value: bytes.getFloat32(2 * n + 4 * k, true),
        trusted: (bytes.getUint8(6 * n + (k >> 3)) >> (k & 7)) & 1,
      });
    }
    return points;
  }

  /* Round numbers between two ends, two to four of them. */
  function ticks(low, high) {
    const rough = (high - low) / 3;
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= rough * 0.999);
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
    return found;
  }

  function ownRange(points) {
    const finite = points.filter((p) => Number.isFinite(p.value));
    const believed = finite.filter((p) => p.trusted);
    const values = (believed.length ? believed : finite).map((p) => p.value);
    if (!values.length) return [0, 1];
    const low = Math.min(...values), high = Math.max(...values);
    const margin = 0.1 * (high - low) || 0.1 * Math.abs(high) || 1;
    return [low - margin, high + margin];
  }

  /* Lines between neighbours of equal trust, and dots where a trusted window stands alone. */
  function paths(points, x, y) {
    const path = { trusted: "", doubted: "" };
    points.forEach((p, k) => {
      if (!Number.isFinite(p.value)) return;
      const [before, after] = [points[k - 1], points[k + 1]];
      const joined = (other) => other && Number.isFinite(other.value);
      if (joined(before)) {
        const kind = p.trusted && before.trusted ? "trusted" : "doubted";
        path[kind] += `M${x(before.time)} ${y(before.value)}L${x(p.time)} ${y(p.value)}`;
      }
      const alone = !(joined(before) && before.trusted) && !(joined(after) && after.trusted);
      if (p.trusted && alone) path.trusted += `M${x(p.time)} ${y(p.value)}h0`;
      if (!p.trusted && !joined(before) && !joined(after)) path.doubted += `M${x(p.time) - 1} ${y(p.value)}h2`;
    });
    return path;
  }

  function picture(row, common) {
    const points = unpack(row);
    const spans = series.spans;
    const [low, high] = (common && series.range) || ownRange(points);
    const begin = common ? Math.min(0, spans[row][0]) : spans[row][0];
    const end = (common ? longest : spans[row][1]) || begin + 1;
    const keep = (value, from, to) => Math.min(Math.max(value, from), to);
    const x = (time) => +(LEFT + (WIDTH - LEFT - RIGHT) * (time - begin) / (end - begin || 1)).toFixed(1);
    const place = (value) => HEIGHT - BOTTOM - (HEIGHT - BOTTOM - TOP) * (value - low) / (high - low);
    const y = (value) => +keep(place(value), TOP, HEIGHT - BOTTOM).toFixed(1);
    const image = drawn("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, "aria-hidden": "true", preserveAspectRatio: "xMinYMid" });
    for (const tick of ticks(low, high)) {
      image.append(drawn("path", { class: "grid", d: `M${LEFT} ${y(tick)}H${WIDTH - RIGHT}` }));
      const label = drawn("text", { x: LEFT - 4, y: y(tick) + 3.5, "text-anchor": "end" });
      label.textContent = number(tick);
      image.append(label);
    }
    image.append(drawn("path", { class: "axis", d: `M${LEFT} ${TOP}V${HEIGHT - BOTTOM}H${WIDTH - RIGHT}` }));
    const within = ticks(begin, end);
    within.forEach((tick, k) => {
      const last = k === within.length - 1;
      const label = drawn("text", { x: x(tick), y: HEIGHT - 4, "text-anchor": last && k ? "end" : "middle" });
      label.textContent = number(tick) + (last ? " s" : "");
      image.append(drawn("path", { class: "axis", d: `M${x(tick)} ${HEIGHT - BOTTOM}v3` }), label);
    });
    const path = paths(points, x, y);
    image.append(drawn("path", { class: "doubted", d: path.doubted }), drawn("path", { class: "trusted", d: path.trusted }));
    return image;
  }

  function inWords(row) {
    const { name, unit } = data.parameter ?? {};
    const mean = column.get(`${name}_mean`), sd = column.get(`${name}_sd`);
    if (!mean || mean.values[row] === null) return "no trusted window";
    const spread = sd && sd.values[row] !== null ? ` ± ${number(sd.values[row], 2)}` : "";
    return `mean ${number(mean.values[row])}${spread} ${unit}`;
  }

  function makePanel(row, common) {
    const panel = element("div", "", "panel");
    const title = element("h3");
    title.append(named(row));
    title.title = recordings[row];
    panel.append(title);
    if (failed(row)) {
      const reason = column.get("reason")?.values[row] ?? "no reason given";
      panel.append(element("p", `${column.get("status").values[row] ?? "failed"}: ${reason}`, "failure"));
    } else {
      panel.append(element("p", inWords(row)));
      panel.append(series.counts[row] ? picture(row, common) : element("p", "no windows to draw"));
    }
    return panel;
  }

  function panelSpace() {
    const whole = element("div", "", "space");
    return { whole, height: (pixels) => { whole.style.height = `${pixels}px`; } };
  }

  let across = 1;
  const longest = series.spans.reduce((most, span) => Math.max(most, span[1]), 0);

  function makeStrip(k) {
    const common = at("scales").elements.scale.value === "common";
    const strip = element("div", "", "strip");
    strip.style.gridTemplateColumns = `repeat(${across}, minmax(0, 1fr))`;
    for (const row of order.slice(k * across, (k + 1) * across)) strip.append(makePanel(row, common));
    return strip;
  }

  // ---- putting it together -----------------------------------------------------------------------------------------

  makeHeads();
  const lines = seenRows(table, table.querySelector("tbody"), tableSpace, makeRow);
  const strips = panels && seenRows(panels, panels, panelSpace, makeStrip);
  let panelsSeen = false;

  function showPanels() {
    if (!panels || !panelsSeen) return;
    across = Math.max(1, Math.floor(panels.clientWidth / 240));
    strips.show(Math.ceil(order.length / across));
  }

  function show() {
    select();
    markHeads();
    table.firstElementChild.setAttribute("aria-rowcount", order.length + 1);
    lines.show(order.length);
    const all = recordings.length;
    at("count").textContent = order.length === all ? `${all} recordings` : `${order.length} of ${all} recordings`;
    showPanels();
  }

  function changed() {
    writeAddress();
    show();
    table.scrollTop = 0;
    if (panels) panels.scrollTop = 0;
  }

  const filters = at("filters");
  const lists = new Map();

  function makeFilters() {
    for (const one of columns.filter((one) => one.choices)) {
      const label = element("label", one.label);
      const list = document.createElement("select");
      list.append(new Option("all", ""));
      const rows = new Map(one.values.map((value, row) => [value, row]));
      const values = [...rows.keys()].filter((value) => value !== null);
      values.sort(one.kind === "text" ? collator.compare : (a, b) => a - b);
      if (rows.has(null)) values.push(null);
      for (const value of values) list.append(new Option(shown(one, rows.get(value))));
      list.addEventListener("change", () => {
        if (list.selectedIndex) state.chosen.set(one.name, list.value);
        else state.chosen.delete(one.name);
        changed();
      });
      label.append(list);
      filters.insertBefore(label, filters.lastElementChild);
      lists.set(one.name, list);
    }
    at("text").addEventListener("input", () => { state.text = at("text").value; changed(); });
    filters.addEventListener("submit", (event) => event.preventDefault());
    filters.addEventListener("reset", (event) => {
      event.preventDefault();
      state.text = "";
      state.chosen.clear();
      showFilters();
      changed();
    });
    const button = at("show-failures");
    if (!button) return;
    button.hidden = false;
    button.addEventListener("click", () => {
      const list = lists.get("status");
      state.chosen.clear();
      state.text = "";
      const status = column.get("status").values.find((value) => value !== "ok");
      if (list) state.chosen.set("status", status ?? "–");
      showFilters();
      changed();
      at("recordings").scrollIntoView();
      table.focus({ preventScroll: true });
    });
  }

  function showFilters() {
    at("text").value = state.text;
    for (const [name, list] of lists) list.value = state.chosen.get(name) ?? "";
  }

  makeFilters();
  readAddress();
  showFilters();
  filters.hidden = table.hidden = false;
  show();
  requestAnimationFrame(() => setTimeout(() => { // after the first picture of it
    document.documentElement.dataset.usable = performance.now().toFixed(1);
  }));

  addEventListener("hashchange", () => { readAddress(); showFilters(); show(); });
  new ResizeObserver(() => lines.draw()).observe(table);

  /* Panels wait until the page has them all and somebody comes near. */
  function watchPanels() {
    panels.hidden = at("scales").hidden = false;
    at("scales").addEventListener("change", showPanels);
    new IntersectionObserver((seen, observer) => {
      if (!seen.some((one) => one.isIntersecting)) return;
      observer.disconnect();
      panelsSeen = true;
      showPanels();
    }, { rootMargin: "300px" }).observe(panels);
    let wide = panels.clientWidth;
    new ResizeObserver(() => {
      if (panels.clientWidth === wide) return strips.draw();
      wide = panels.clientWidth;
      return showPanels();
    }).observe(panels);
  }
  if (panels) {
    if (document.readyState === "loading") addEventListener("DOMContentLoaded", watchPanels);
    else watchPanels();
  }
})();
