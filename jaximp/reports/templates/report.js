"use strict";
/* Draws the figures of a report in place of their pictures, and tells of the window that a reader picks. */
(() => {
  const at = (id) => document.getElementById(id);
  const root = document.documentElement;

  /* A number of four digits, as the rest of the page writes it. */
  function number(value, digits = 4) {
    if (!Number.isFinite(value)) return "–";
    const size = Math.abs(value);
    if (size !== 0 && (size < 1e-4 || size >= 1e5)) {
      const [mantissa, exponent] = value.toExponential(digits - 1).split("e");
      const raised = String(Number(exponent)).replace(/./g, (c) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(c)]);
      return `${String(Number(mantissa)).replace("-", "−")}×10${raised}`;
    }
    return String(Number(value.toPrecision(digits))).replace("-", "−");
  }

  function element(name, text, kind) {
    const made = document.createElement(name);
    made.textContent = text ?? "";
    if (kind) made.className = kind;
    return made;
  }

  function row(of) {
    const line = element("tr");
    const value = element("td", `${number(of.value)} ${of.unit}`, "answer");
    value.append(element("small", `${number(of.low, 3)} to ${number(of.high, 3)}`));
    line.append(element("th", of.name), value);
    return line;
  }

  function tell(of) {
    const table = element("table");
    table.append(element("tbody"));
    table.firstChild.append(...of.values.map(row));
    const verdict = element("p", "", of.verdict === "trusted" ? "verdict" : "verdict doubted");
    verdict.append(element("strong", of.verdict), `, ${number(of.start, 5)} to ${number(of.end, 5)} s`);
    const parts = [verdict];
    if (of.reason) parts.push(element("p", `${of.reason[0].toUpperCase()}${of.reason.slice(1)}.`));
    if (of.remark) parts.push(element("p", of.remark, "remark"));
    at("about-window").replaceChildren(...parts, table);
  }

  /* Pick the window so many further on. */
  function step(drawn, by) {
    const { start, end } = drawn.get_model_by_name("windows").data;
    const picked = drawn.get_model_by_name("picked");
    const k = Math.min(Math.max(picked.data.row[0] + by, 0), start.length - 1);
    picked.data = { row: [k], start: [start[k]], end: [end[k]] };
  }

  /* Figures are drawn when somebody comes near: the roots of the others wait outside of the document. */
  async function draw() {
    Bokeh.logger.set_level("warn");
    const { document: json, places } = JSON.parse(at("figures").textContent);
    await Bokeh.embed.embed_items({ none: { ...json, roots: [] } }, [{ docid: "none", roots: {}, root_ids: [] }]);
    const Document = Bokeh.documents[0].constructor; // which BokehJS does not name, and an empty one shows
    const drawn = Document.from_json(json);
    const waiting = new Map(Object.entries(places).map(([place, id]) => [place, drawn.get_model_by_id(id)]));
    for (const model of waiting.values()) drawn.remove_root(model);
    root.classList.add("drawn"); // places have their widths before they are filled
    const elements = []; // of the document's roots, in their order
    await Bokeh.embed.add_document_standalone(drawn, document.body, elements);
    const fill = (place) => {
      if (!waiting.has(place)) return;
      elements.push(at(place));
      drawn.add_root(waiting.get(place));
      waiting.delete(place);
    };
    for (const button of document.querySelectorAll(".steps button")) {
      button.addEventListener("click", () => step(drawn, Number(button.value)));
    }
    const observer = new IntersectionObserver((seen) => {
      for (const { isIntersecting, target } of seen) {
        if (!isIntersecting) continue;
        observer.unobserve(target);
        fill(target.id);
        fill(`${target.id}-beside`);
        if (target.parentElement.classList.contains("pair")) step(drawn, 0);
      }
      root.dataset.usable ??= performance.now().toFixed(1);
    }, { rootMargin: "400px" });
    for (const place of waiting.keys()) if (!place.endsWith("-beside")) observer.observe(at(place));
  }

  for (const link of document.querySelectorAll("a.png")) {
    link.href = link.closest("figure").querySelector("img").src;
  }
  document.addEventListener("jaximp-window", (event) => tell(event.detail));
  requestAnimationFrame(() => setTimeout(() => draw().catch((error) => { // after the first picture of the page
    root.classList.remove("drawn"); // the pictures are there
    throw error;
  })));
})();
