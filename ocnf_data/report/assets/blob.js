// Arrays of a sample: from the page itself, or from a script beside it, unpacked (ocnf_data/report/blob.py).
"use strict";
const ocnf = {};

(() => {
  const kinds = { uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array };

  // {arrays: {name: {shape, data}}, meta} of the string that blob.py's `pack` made.
  ocnf.unpack = async (text) => {
    const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const raw = new Uint8Array(await new Response(stream).arrayBuffer());
    const end = 4 + new DataView(raw.buffer).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(raw.subarray(4, end)));
    const arrays = {};
    for (const [name, [kind, shape, offset, coding]] of Object.entries(header.arrays)) {
      const n = shape.reduce((product, length) => product * length, 1);
      const part = raw.subarray(end + offset, end + offset + n * kinds[kind].BYTES_PER_ELEMENT);
      arrays[name] = { shape, data: coding === "plain" ? part : summed(part, kinds[kind], n, n / shape[0] || 1) };
    }
    return { arrays, meta: header.meta };
  };

  // Byte planes to numbers, differences to values; the typed array wraps around by itself.
  function summed(planes, Kind, n, step) {
    const values = new Kind(n);
    for (let i = 0; i < n; i++) {
      let value = 0;
      for (let plane = Kind.BYTES_PER_ELEMENT - 1; plane >= 0; plane--) value = value * 256 + planes[plane * n + i];
      values[i] = i < step ? value : value + values[i - step];
    }
    return values;
  }

  const waiting = new Map(); // number: {key, resolve, reject}

  // What a script of the folder beside the page calls.
  window.ocnfReceive = (number, key, text) => {
    const request = waiting.get(number);
    waiting.delete(number);
    if (!request) return;
    if (request.key === key) request.resolve(text);
    else request.reject(new Error(`${place(number)} belongs to another page: write the page again`));
  };

  const place = (number) => `${ocnf.page.folder}/${String(number).padStart(6, "0")}.js`;

  function fromScript(number, key) {
    return new Promise((resolve, reject) => {
      waiting.set(number, { key, resolve, reject });
      const script = document.createElement("script");
      script.src = place(number).split("/").map(encodeURIComponent).join("/");
      const fail = () => {
        if (waiting.delete(number)) {
          reject(new Error(`${place(number)} cannot be read. The folder ${ocnf.page.folder} belongs to this page: `
            + "keep them side by side"));
        }
      };
      script.onload = () => { script.remove(); fail(); };
      script.onerror = () => { script.remove(); fail(); };
      document.body.append(script);
    });
  }

  const kept = new Map(); // number: promise; the last few samples

  // What there is to see of the sample of that number.
  ocnf.load = (number) => {
    if (!kept.has(number)) {
      const element = document.getElementById(`geometry-${number}`);
      const text = element ? Promise.resolve(element.textContent) : fromScript(number, ocnf.page.samples[number].key);
      const found = text.then(ocnf.unpack);
      found.catch(() => kept.delete(number));
      kept.set(number, found);
      if (kept.size > 6) kept.delete(kept.keys().next().value);
    }
    return kept.get(number);
  };
})();
