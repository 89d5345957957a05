// Puts the page together: head, tabs, tables, and the sample that the address names.
"use strict";

(() => {
  const { make, by } = ocnf;
  ocnf.page = JSON.parse(by("page-data").textContent);
  const { page } = ocnf;
  let open = null; // number of the sample in the viewer

  // ---- light and dark: as the system has it, until someone chooses

  const root = document.documentElement;
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const follow = () => { root.dataset.theme = dark.matches ? "dark" : "light"; ocnf.viewer.redraw(); };
  follow();
  dark.addEventListener("change", follow);
  for (const button of document.querySelectorAll("[data-theme-switch]")) {
    button.onclick = () => {
      dark.removeEventListener("change", follow);
      root.dataset.theme = root.dataset.theme === "dark" ? "light" : "dark";
      ocnf.viewer.redraw();
    };
  }

  // ---- head and tabs

  by("title").textContent = page.title;
  by("subtitle").textContent = page.subtitle;
  by("facts").append(...page.facts.map(([name, value]) => make("div", {}, make("dt", {}, name), make("dd", {}, value))));
  by("notes").append(...page.notes.map((note) => make("p", { className: "note" }, note)));
  const spreads = page.columns.map((column, at) => ocnf.histogram(column, page.samples.map((sample) => sample.values[at]))).filter(Boolean);
  by("tab-statistics").append(...page.tables.map(ocnf.table));
  if (spreads.length) by("tab-statistics").prepend(make("h3", {}, "Over the samples"), make("div", { className: "histograms" }, ...spreads));
  if (page.failures) {
    by("tab-failures").append(page.failures.rows.length ? ocnf.table(page.failures)
      : make("p", {}, "None: every input gave a sample, and every sample is shown."));
  }
  by("tab-provenance").append(...page.provenance.flatMap(([title, text]) => [make("h3", {}, title), make("pre", {}, text)]));
  const tabs = [...document.querySelectorAll("[data-tab]")].filter((tab) => tab.childElementCount);
  for (const tab of tabs) {
    const n = { Gallery: page.samples.length, Failures: page.failures?.rows.length }[tab.dataset.tab];
    const button = make("button", { type: "button", role: "tab" }, tab.dataset.tab + (n === undefined ? "" : ` (${n.toLocaleString("en")})`));
    button.onclick = () => select(tab);
    button.dataset.selects = tab.id;
    by("tabs").append(button);
  }

  function select(chosen) {
    for (const tab of tabs) tab.hidden = tab !== chosen;
    for (const button of by("tabs").children) button.ariaSelected = String(button.dataset.selects === chosen.id);
  }

  // ---- a sample is open while the address names it, so that it can be linked to and Back leaves it

  const address = (number) => `#sample/${encodeURIComponent(page.samples[number].key)}`;
  const go = (number) => { location.hash = address(number); };
  const step = (by_) => {
    const order = ocnf.order(), place = order.indexOf(open);
    const number = order[place + by_];
    if (place >= 0 && number !== undefined) history.replaceState(null, "", address(number));
    if (place >= 0 && number !== undefined) enter();
  };
  const leave = () => { history.pushState(null, "", location.pathname + location.search); enter(); };

  async function enter() {
    const key = location.hash.startsWith("#sample/") ? decodeURIComponent(location.hash.slice(8)) : null;
    const number = page.samples.findIndex((sample) => sample.key === key);
    if (number === open) return;
    open = number < 0 ? null : number;
    by("viewer").hidden = open === null;
    document.body.style.overflow = open === null ? "" : "hidden";
    delete root.dataset.sample;
    if (open === null) return;
    const sample = page.samples[number], order = ocnf.order(), place = order.indexOf(number);
    by("sample-key").textContent = sample.key;
    by("sample-facts").textContent = [`${sample.category}, ${sample.split}`,
      ...page.columns.map((_, at) => ocnf.measured(sample, at)), sample.source].join("  ·  ");
    by("sample-facts").title = by("sample-facts").textContent;
    by("position").textContent = place < 0 ? "" : `${place + 1} of ${order.length}`;
    by("previous").disabled = place <= 0;
    by("next").disabled = place < 0 || place === order.length - 1;
    ocnf.viewer.show(null, "Loading …");
    ocnf.showFlat(null);
    try {
      const found = await ocnf.load(number);
      if (open !== number) return;
      found.meta.number = number;
      ocnf.viewer.show(found);
      ocnf.showFlat(found);
    } catch (error) {
      if (open === number) ocnf.viewer.show(null, error.message);
    }
    root.dataset.sample = sample.key;
  }

  by("back").onclick = leave;
  by("previous").onclick = () => step(-1);
  by("next").onclick = () => step(1);
  window.addEventListener("hashchange", enter);
  window.addEventListener("popstate", enter);
  document.addEventListener("keydown", (event) => {
    if (open === null || by("large").open || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "Escape") leave();
    else if (event.target.matches?.("select, input[type=range]")) return;
    else if (event.key === "ArrowLeft") step(-1);
    else if (event.key === "ArrowRight") step(1);
    else if (!ocnf.viewer.key(event.key.toLowerCase())) return;
    event.preventDefault();
  });

  ocnf.startGallery(go);
  select(tabs[0]);
  enter();
})();
