// Depth maps, and slices with the octree's cells.
"use strict";

(() => {
  const { make, by } = ocnf;
  let urls = [];

  // Fill the column beside the 3-D view.
  ocnf.showFlat = (found) => {
    for (const url of urls) URL.revokeObjectURL(url);
    urls = [];
    by("side").replaceChildren();
    by("side").scrollTop = 0;
    if (!found) return;
    const { slices, depths } = found.meta;
    if (slices.length) {
      by("side").append(make("div", { className: "block" }, make("h3", {}, "Slices with the octree's cells"),
        make("div", { className: "slices" }, ...slices.map((slice, number) => sliceFigure(found, slice, number))),
        ocnf.scale(ocnf.page.distanceColours, ["inside or unseen, −τ", "0", "free, τ"], "scale short"),
        make("div", { className: "keys" }, make("span", {}, "τ: the truncation distance. Point at a cell for its size and value; click to enlarge."))));
    }
    if (depths.length) {
      const limits = depths.find((depth) => depth.limits)?.limits;
      by("side").append(make("div", { className: "block" }, make("h3", {}, "Depth maps"),
        make("div", { className: "grid" }, ...depths.map((depth, number) => depthFigure(found, depth, number))),
        ...(limits ? [ocnf.scale(found.meta.depthColours, [`${limits[0].toFixed(2)} m`, `${limits[1].toFixed(2)} m`], "scale short")] : []),
        make("div", { className: "keys" }, key("#ffffff", "free ray, nothing hit"), key("#d94040", "no measurement"))));
    }
  };

  const key = (colour, text) => {
    const square = make("i");
    square.style.background = colour;
    return make("span", {}, square, text);
  };

  function depthFigure(found, depth, number) {
    const url = URL.createObjectURL(new Blob([found.arrays[`depth${number}`].data], { type: "image/webp" }));
    urls.push(url);
    const figure = make("figure", {}, make("img", { src: url, alt: `depth map, ${depth.title}` }),
      make("figcaption", {}, depth.title));
    figure.onclick = () => enlarge(make("figure", {}, make("img", { src: url, alt: "" }), make("figcaption", {}, depth.title)));
    return figure;
  }

  function sliceFigure(found, slice, number) {
    const cells = { squares: found.arrays[`slice${number}/squares`].data, values: found.arrays[`slice${number}/values`].data };
    const caption = () => make("figcaption", {}, make("b", {}, slice.name), ` ${slice.title}`);
    const figure = make("figure", {}, drawn(slice, cells, 640), caption());
    figure.onclick = () => enlarge(make("figure", {}, drawn(slice, cells, 0.8 * Math.min(innerWidth, innerHeight) * devicePixelRatio, true), caption()));
    return figure;
  }

  // A canvas of a slice, the first row at the bottom; cells of 3 pixels and more have outlines. `exact`: a pixel
  // of it is one of the screen.
  function drawn(slice, { squares, values }, pixels, exact = false) {
    const unit = Math.max(1, Math.floor(pixels / Math.max(slice.width, slice.height)));
    const canvas = make("canvas", { width: slice.width * unit, height: slice.height * unit });
    if (exact) canvas.style.width = `${canvas.width / devicePixelRatio}px`;
    const context = canvas.getContext("2d");
    const colour = ocnf.ramp(ocnf.page.distanceColours);
    const n = values.length;
    for (let i = 0; i < n; i++) {
      const [row, column, width] = squares.subarray(3 * i, 3 * i + 3);
      const top = (slice.height - row - width) * unit;
      context.fillStyle = `rgb(${colour(values[i] / 255).map(Math.round).join(" ")})`;
      context.fillRect(column * unit, top, width * unit, width * unit);
      if (width * unit >= 3) {
        context.strokeStyle = "rgb(40 44 48 / 0.3)";
        context.strokeRect(column * unit + 0.5, top + 0.5, width * unit, width * unit);
      }
    }
    canvas.onpointermove = (event) => {
      const column = Math.floor((event.offsetX / canvas.clientWidth) * slice.width);
      const row = slice.height - 1 - Math.floor((event.offsetY / canvas.clientHeight) * slice.height);
      for (let i = 0; i < n; i++) {
        const [low, left, width] = squares.subarray(3 * i, 3 * i + 3);
        if (row >= low && row < low + width && column >= left && column < left + width) {
          tip(event, `${slice.up} ${row}, ${slice.right} ${column}: a cell of ${width === 1 ? "1 voxel" : `${width}³ voxels`}, `
            + `${(values[i] / 127.5 - 1).toFixed(2).replace("-", "−")} τ`);
          return;
        }
      }
    };
    canvas.onpointerleave = () => { by("tip").hidden = true; };
    return canvas;
  }

  function tip(event, text) {
    const box = by("tip");
    box.textContent = text;
    box.hidden = false;
    box.style.left = `${Math.min(event.clientX + 12, innerWidth - box.offsetWidth - 6)}px`;
    box.style.top = `${Math.min(event.clientY + 14, innerHeight - box.offsetHeight - 6)}px`;
    (event.target.closest("dialog") || document.body).append(box);
  }

  function enlarge(figure) {
    by("large-body").replaceChildren(figure);
    by("large").showModal();
  }

  by("large-close").onclick = () => by("large").close();
  by("large").onclick = (event) => { if (event.target === by("large")) by("large").close(); };
  by("large").onclose = () => { by("tip").hidden = true; document.body.append(by("tip")); };
})();
