// Small things that all parts use, and tables that sort themselves.
"use strict";

(() => {
  // An element with properties and children: make("td", {className: "text"}, "…").
  ocnf.make = (tag, properties = {}, ...children) => {
    const element = Object.assign(document.createElement(tag), properties);
    element.append(...children);
    return element;
  };
  const make = ocnf.make;
  ocnf.by = (id) => document.getElementById(id);

  // What a sample has in a column: "VolFus error 83.2 mm".
  ocnf.measured = (sample, number) => {
    const { label, digits, unit } = ocnf.page.columns[number], value = sample.values[number];
    return `${label} ${ocnf.number(value, digits)}${value === null || !unit ? "" : unit[0] === "%" ? unit : ` ${unit}`}`;
  };

  // A number with so many digits after the point; without `digits`, three significant ones.
  ocnf.number = (value, digits) => {
    if (value === null || value === undefined) return "–";
    const places = digits ?? (value === 0 ? 0 : Math.max(0, 2 - Math.floor(Math.log10(Math.abs(value)))));
    return value.toLocaleString("en", { minimumFractionDigits: Math.min(places, 6), maximumFractionDigits: Math.min(places, 6) });
  };

  // Ascending; what is not known comes last in both directions.
  ocnf.compare = (a, b, descending) => {
    if (a === null || b === null) return (a === null) - (b === null);
    const order = typeof a === "number" && typeof b === "number" ? a - b
      : String(a).localeCompare(String(b), "en", { numeric: true });
    return descending ? -order : order;
  };

  const isText = (table, column) => table.rows.some((row) => typeof row[column] === "string");

  ocnf.table = (table) => {
    const body = make("tbody");
    const texts = table.head.map((_, column) => isText(table, column));
    const isTotal = (row) => table.total && row === table.rows.at(-1);
    const largest = table.head.map((_, column) =>
      Math.max(...table.rows.filter((row) => !isTotal(row)).map((row) => row[column] || 0), 0));
    // A column of whole numbers has no decimals; in others every number has three significant digits.
    const isWhole = table.head.map((_, column) => table.rows.every((row) => typeof row[column] !== "number" || Number.isInteger(row[column])));
    const rows = table.rows.map((row) => make("tr", { className: isTotal(row) ? "total" : "" }, ...row.map((value, column) => {
      const text = typeof value === "number" ? ocnf.number(value, isWhole[column] ? 0 : undefined) : value ?? "–";
      const cell = make("td", { className: texts[column] ? "text" : "" }, text);
      if (texts[column] && text.length > 48) cell.className = "text long";
      if (table.bars.includes(column) && value && !isTotal(row)) {
        cell.className = "barred";
        cell.style.setProperty("--share", `${(100 * value) / largest[column]}%`);
      }
      return cell;
    })));
    const heads = table.head.map((name, column) => {
      const button = make("button", { type: "button" }, name);
      const head = make("th", { className: texts[column] ? "text" : "" }, button);
      button.onclick = () => {
        const descending = head.ariaSort ? head.ariaSort === "ascending" : !texts[column];
        for (const other of heads) other.ariaSort = null;
        head.ariaSort = descending ? "descending" : "ascending";
        const order = [...rows.keys()].sort((a, b) => isTotal(table.rows[a]) - isTotal(table.rows[b])
          || ocnf.compare(table.rows[a][column], table.rows[b][column], descending));
        body.replaceChildren(...order.map((number) => rows[number]));
      };
      return head;
    });
    body.append(...rows);
    return make("div", { className: "table" }, make("h3", {}, table.title),
      make("div", { className: "scroll" }, make("table", {}, make("thead", {}, make("tr", {}, ...heads)), body)),
      ...(table.note ? [make("p", {}, table.note)] : []));
  };

  // How a column's values are spread over the samples: counts in 24 equal steps from the least to the most.
  ocnf.histogram = (column, values) => {
    const known = values.filter((value) => value !== null).sort((a, b) => a - b);
    if (known.length < 3 || known[0] === known.at(-1)) return null;
    const bins = new Array(24).fill(0), low = known[0], span = known.at(-1) - low;
    for (const value of known) bins[Math.min(23, Math.floor((24 * (value - low)) / span))] += 1;
    const most = Math.max(...bins), unit = column.unit && ` ${column.unit}`;
    const bars = bins.map((n, bin) => {
      const bar = make("i", { title: `${n} from ${ocnf.number(low + (bin * span) / 24)} to ${ocnf.number(low + ((bin + 1) * span) / 24)}${unit}` });
      bar.style.height = `${(100 * n) / most}%`;
      return bar;
    });
    return make("div", { className: "histogram" }, make("b", {}, column.label), make("div", {}, ...bars),
      make("p", {}, make("span", {}, ocnf.number(low)), make("span", {}, `median ${ocnf.number(known[known.length >> 1])}${unit}`),
        make("span", {}, ocnf.number(known.at(-1)))));
  };

  // Colours between stops ["#rrggbb", ...] at 0..1, as [r, g, b] of 0..255.
  ocnf.ramp = (stops) => {
    const parts = stops.map((stop) => [1, 3, 5].map((at) => parseInt(stop.slice(at, at + 2), 16)));
    return (share) => {
      const place = Math.min(Math.max(share, 0), 1) * (parts.length - 1);
      const low = Math.min(Math.floor(place), parts.length - 2);
      return parts[low].map((value, channel) => value + (parts[low + 1][channel] - value) * (place - low));
    };
  };

  // A colour scale with labels below it, at equal distances.
  ocnf.scale = (stops, labels, className = "scale") => {
    const line = make("i");
    line.style.background = `linear-gradient(to right, ${stops.join(", ")})`;
    const ticks = labels.map((label, number) => {
      const tick = make("span", {}, ...label.split("\n").flatMap((part, row) => (row ? [make("br"), part] : [part])));
      const share = (100 * number) / (labels.length - 1);
      Object.assign(tick.style, { left: `${share}%`, translate: `-${share}%`, textAlign: ["left", "right"][number && number / (labels.length - 1)] || "center" });
      return tick;
    });
    const below = make("span", { className: labels.some((label) => label.includes("\n")) ? "ticks two" : "ticks" }, ...ticks);
    return make("span", { className }, line, below);
  };
})();
