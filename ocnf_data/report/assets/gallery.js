// The gallery: thumbnails that are searched, filtered and sorted.
"use strict";

(() => {
  const { make, by } = ocnf;
  let cards, order;

  // Numbers of the samples that are shown now, in their order.
  ocnf.order = () => order;

  ocnf.startGallery = (open) => {
    const { samples, columns } = ocnf.page;
    choices(by("category"), "all", samples.map((sample) => sample.category));
    choices(by("split"), "all", samples.map((sample) => sample.split));
    by("group").textContent = ocnf.page.group;
    by("split").parentElement.hidden = new Set(samples.map((sample) => sample.split)).size < 2;
    by("sort").append(option("", "order of the data set"), option("key", "name"),
      ...columns.map((column, number) => option(String(number), column.unit ? `${column.label}, ${column.unit}` : column.label)));
    cards = samples.map((sample, number) => {
      const picture = make("img", { loading: "lazy", alt: "", src: `data:image/webp;base64,${sample.thumbnail}` });
      delete sample.thumbnail;
      const card = make("button", { type: "button", className: "card", title: `${sample.key}\n${sample.source}` }, picture,
        make("span", { className: "name" }, sample.key),
        make("span", { className: "kind" }, `${sample.category}, ${sample.split}`),
        make("span", { className: "value" }));
      card.dataset.key = sample.key;
      card.onclick = () => open(number);
      return card;
    });
    for (const id of ["search", "category", "split", "sort", "descending"]) by(id).addEventListener("input", arrange);
    by("controls").addEventListener("submit", (event) => event.preventDefault());
    by("clear").onclick = () => { by("search").value = by("category").value = by("split").value = ""; arrange(); };
    arrange();
  };

  const option = (value, text) => make("option", { value }, text);

  function choices(select, all, values) {
    const counts = new Map();
    for (const value of values) counts.set(value, (counts.get(value) || 0) + 1);
    select.append(option("", `${all} (${values.length})`),
      ...[...counts].sort(([a], [b]) => ocnf.compare(a, b)).map(([value, n]) => option(value, `${value} (${n})`)));
  }

  function arrange() {
    const { samples, columns } = ocnf.page;
    const words = by("search").value.toLowerCase().split(/\s+/).filter(Boolean);
    const category = by("category").value, split = by("split").value, sort = by("sort").value;
    const descending = by("descending").checked;
    order = [...samples.keys()].filter((number) => {
      const sample = samples[number];
      const text = `${sample.key} ${sample.category} ${sample.source}`.toLowerCase();
      return (!category || sample.category === category) && (!split || sample.split === split)
        && words.every((word) => text.includes(word));
    });
    const value = sort === "key" ? (number) => samples[number].key : (number) => samples[number].values[Number(sort)];
    if (sort) order.sort((a, b) => ocnf.compare(value(a), value(b), descending) || a - b);
    else if (descending) order.reverse();
    const shown = sort && sort !== "key" ? Number(sort) : columns.length - 1;
    for (const number of order) {
      cards[number].querySelector(".value").textContent = columns.length
        ? ocnf.measured(samples[number], shown) : "";
    }
    by("cards").replaceChildren(...order.map((number) => cards[number]));
    by("count").value = order.length === samples.length ? `${ocnf.number(order.length, 0)} samples`
      : `${ocnf.number(order.length, 0)} of ${ocnf.number(samples.length, 0)} samples`;
    by("nothing").hidden = order.length > 0 || samples.length === 0;
  }
})();
