// The 3-D view: one canvas, one camera, one or several views side by side.
"use strict";

(() => {
  const { make, by } = ocnf;
  const STEPS = 65535; // of positions over the cube (geometry.py)
  const PLAIN = "#cbc5ba", INSIDE = "#a9714f", POINT = "#47688a", NO_ERROR = "#b9bcc0";
  const FIELD = 32; // degrees of the camera
  const POINTS_ACROSS = 320; // points side by side fill the cube
  const FRONT = 0, BACK = 1, BOTH = 2; // sides of THREE's materials
  const AXES = ["x", "y", "z"];

  const state = { layout: "1", names: [], active: 0, error: false, wireframe: false, box: false, axis: "", place: 500, flip: false };
  let renderer, scene, camera, controls, light, box, plane, items = [], meta = null, isWaiting = false, broken = "";

  ocnf.viewer = { state, show, redraw: () => draw() };

  // ---- once

  function start() {
    if (renderer || broken) return;
    try {
      renderer = new THREE.WebGLRenderer({ canvas: by("canvas"), antialias: true, powerPreference: "low-power" });
    } catch {
      broken = "This browser gives no WebGL, so that there is no 3-D view here. Depth maps and slices are shown beside it.";
      return;
    }
    renderer.localClippingEnabled = true;
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    scene = new THREE.Scene();
    scene.add(new THREE.HemisphereLight(0xffffff, 0x9c968c, 1.75));
    light = new THREE.DirectionalLight(0xffffff, 1.7);
    scene.add(light, light.target);
    camera = new THREE.PerspectiveCamera(FIELD, 1, 0.01, 100);
    if (ocnf.page.up === "z") camera.up.set(0, 0, 1);
    plane = new THREE.Plane(new THREE.Vector3(-1, 0, 0), 0);
    const half = ocnf.page.scale.extent / 2;
    box = new THREE.Box3Helper(new THREE.Box3(new THREE.Vector3(-half, -half, -half), new THREE.Vector3(half, half, half)), 0x8b939b);
    scene.add(box);
    controls = new THREE.OrbitControls(camera, by("canvas"));
    controls.addEventListener("change", draw);
    by("canvas").addEventListener("webglcontextlost", (event) => { event.preventDefault(); say("The graphics card took the 3-D view away. Reload the page."); });
    new ResizeObserver(draw).observe(by("stage"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  }

  // ---- a sample

  // Show what was unpacked of a sample; null: nothing, while it is being loaded or where that failed.
  function show(found, message = "") {
    start();
    for (const item of items) {
      scene?.remove(item.group);
      for (const part of item.disposable) part.dispose();
    }
    items = [];
    meta = found?.meta ?? null;
    say(broken || message);
    by("surfaces").replaceChildren();
    if (found && !broken) {
      items = meta.shown.map((shown, number) => item(found, shown, number));
      scene.add(...items.map((one) => one.group));
    }
    if (found) {
      const first = meta.first || [meta.shown[0].name, meta.shown.at(-1).name];
      const known = (name) => meta.shown.some((shown) => shown.name === name);
      state.names = [0, 1].map((pane) => (known(state.names[pane]) ? state.names[pane] : first[pane]));
      by("surfaces").append(...meta.shown.map((shown, number) => {
        const button = make("button", { type: "button", title: `${shown.caption || shown.name} (key ${number + 1})` }, shown.name);
        button.dataset.surface = shown.name;
        button.onclick = () => choose(shown.name);
        return button;
      }));
      reset();
    }
    refresh();
  }

  function item(found, shown, number) {
    const at = `surface${number}`, { extent } = ocnf.page.scale;
    const packed = found.arrays[`${at}/positions`].data;
    const positions = Float32Array.from(packed, (step) => (step / STEPS - 0.5) * extent);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
    const error = found.arrays[`${at}/error`]?.data;
    if (error) geometry.setAttribute("color", new THREE.BufferAttribute(errorColours(error), 3));
    const one = { shown, group: new THREE.Group(), error: Boolean(error), disposable: [geometry], lines: null, geometry };
    if (shown.kind === "points") {
      one.plain = new THREE.PointsMaterial({ color: POINT });
      one.coloured = error ? new THREE.PointsMaterial({ vertexColors: true }) : one.plain;
      one.parts = [new THREE.Points(geometry, one.plain)];
    } else {
      geometry.setIndex(new THREE.BufferAttribute(found.arrays[`${at}/faces`].data, 1));
      geometry.computeVertexNormals();
      // A closed surface shows its inside, which a clip plane opens, in another colour; meshes made by hand
      // are often open, their triangles turned anyhow.
      const offset = { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1, flatShading: shown.flat };
      const side = shown.flat ? BOTH : FRONT;
      one.plain = new THREE.MeshLambertMaterial({ color: PLAIN, side, ...offset });
      one.coloured = error ? new THREE.MeshLambertMaterial({ vertexColors: true, side, ...offset })
        : new THREE.MeshLambertMaterial({ color: NO_ERROR, side, ...offset });
      one.parts = [new THREE.Mesh(geometry, one.plain)];
      if (!shown.flat) {
        one.inside = new THREE.MeshLambertMaterial({ color: INSIDE, side: BACK, ...offset });
        one.group.add(new THREE.Mesh(geometry, one.inside));
        one.disposable.push(one.inside);
      }
    }
    one.disposable.push(one.plain, one.coloured);
    one.group.add(...one.parts);
    return one;
  }

  function errorColours(bytes) {
    const ramp = ocnf.ramp(ocnf.page.errorColours), colour = new THREE.Color();
    const table = Array.from({ length: 256 }, (_, value) => {
      const [r, g, b] = ramp(value / 255);
      return colour.setRGB(r / 255, g / 255, b / 255, "srgb").toArray();
    });
    const colours = new Float32Array(3 * bytes.length);
    bytes.forEach((value, place) => colours.set(table[value], 3 * place));
    return colours;
  }

  function linesOf(one) {
    if (!one.lines && one.shown.kind === "surface") {
      const geometry = new THREE.WireframeGeometry(one.geometry);
      const material = new THREE.LineBasicMaterial({ color: 0x20262c, transparent: true, opacity: 0.45 });
      one.lines = new THREE.LineSegments(geometry, material);
      one.group.add(one.lines);
      one.disposable.push(geometry, material);
    }
    return one.lines;
  }

  // ---- what is where

  // Names of the surfaces in their panes.
  function paneNames() {
    if (!meta) return [];
    if (state.layout === "all") return meta.shown.map((shown) => shown.name);
    return state.names.slice(0, Number(state.layout));
  }

  // Panes as [left, top, width, height] in CSS pixels: the columns that leave the squarest panes.
  function paneBoxes(n) {
    const width = by("stage").clientWidth, height = by("stage").clientHeight;
    let columns = 1, best = 0;
    for (let tried = 1; tried <= n; tried++) {
      const side = Math.min(width / tried, height / Math.ceil(n / tried));
      if (side > best + 1) [columns, best] = [tried, side];
    }
    const rows = Math.ceil(n / columns);
    return Array.from({ length: n }, (_, pane) => {
      const left = Math.round(((pane % columns) * width) / columns), top = Math.round((Math.floor(pane / columns) * height) / rows);
      return [left, top, Math.round(width / columns), Math.round(height / rows)];
    });
  }

  function choose(name) {
    if (state.layout === "all") state.layout = "1";
    state.names[state.layout === "1" ? 0 : state.active] = name;
    refresh();
  }

  // The same view for every sample: as in its thumbnail, everything in sight.
  function reset() {
    if (broken || !meta) return;
    const box3 = new THREE.Box3();
    for (const one of items.filter((each) => each.shown.kind === "surface")) {
      one.geometry.computeBoundingBox();
      if (!one.geometry.boundingBox.isEmpty()) box3.union(one.geometry.boundingBox);
    }
    const reference = items.find((one) => one.shown.name === meta.frame)?.geometry.boundingBox;
    const frame = reference && !reference.isEmpty() ? reference : box3;
    const half = ocnf.page.scale.extent / 2;
    if (frame.isEmpty()) frame.set(new THREE.Vector3(-half, -half, -half), new THREE.Vector3(half, half, half));
    const centre = frame.getCenter(new THREE.Vector3()), size = frame.getSize(new THREE.Vector3());
    const azimuth = ((meta.azimuth ?? 35) * Math.PI) / 180, elevation = (22 * Math.PI) / 180;
    const [across, ahead, above] = [Math.cos(elevation) * Math.sin(azimuth), -Math.cos(elevation) * Math.cos(azimuth), Math.sin(elevation)];
    const direction = ocnf.page.up === "z" ? new THREE.Vector3(across, ahead, above) : new THREE.Vector3(across, above, -ahead);
    // So far away that every corner of the frame is in sight.
    const right = new THREE.Vector3().crossVectors(camera.up, direction).normalize();
    const top = new THREE.Vector3().crossVectors(direction, right);
    const spread = Math.tan((FIELD / 2) * (Math.PI / 180));
    let distance = 0;
    for (let corner = 0; corner < 8; corner++) {
      const to = size.clone().multiply(new THREE.Vector3(...[1, 2, 4].map((bit) => (corner & bit ? 0.5 : -0.5))));
      const beside = Math.max(Math.abs(to.dot(right)), Math.abs(to.dot(top)));
      distance = Math.max(distance, to.dot(direction) + (1.12 * beside) / spread);
    }
    controls.target.copy(centre);
    camera.position.copy(centre).addScaledVector(direction, distance);
    controls.minDistance = distance / 60;
    controls.maxDistance = 12 * distance;
    controls.update();
    draw();
  }

  // ---- the parts around the canvas

  function refresh() {
    for (const button of by("layout").children) button.ariaPressed = String(button.dataset.layout === state.layout);
    const names = paneNames();
    for (const button of by("surfaces").children) button.ariaPressed = String(names.includes(button.dataset.surface));
    for (const id of ["error", "wireframe", "box"]) by(id).checked = state[id];
    by("clip-axis").value = state.axis;
    by("clip-place").value = state.place;
    by("clip-flip").checked = state.flip;
    by("clip-place").disabled = by("clip-flip").disabled = !state.axis;
    by("clip-value").value = state.axis ? `${state.axis} = ${clipPlace().toFixed(2).replace("-", "−")} m` : "";
    legend(names);
    draw();
  }

  function legend(names) {
    const { error, extent, voxel } = ocnf.page.scale;
    const place = by("error-legend");
    place.replaceChildren();
    if (!meta) return;
    const coloured = meta.shown.filter((shown) => names.includes(shown.name) && shown.hasError);
    if (!state.error) {
      place.append(`The cube is ${extent} m wide, ${Math.round(extent / voxel)} voxels of ${ocnf.number(1000 * voxel)} mm. `
        + "Brown is the inside of a closed surface.");
      return;
    }
    const most = Math.round(error / voxel);
    const labels = Array.from({ length: most + 1 }, (_, n) => `${n}${n === most ? " and more" : ""}\n${ocnf.number(1000 * n * voxel)} mm`);
    place.append(ocnf.scale(ocnf.page.errorColours, labels), make("span", {}, coloured.length
      ? "Distance to the surface of the ground truth, in voxels and in millimetres. Grey: not compared."
      : "Nothing that is shown here has an error: choose another surface."));
  }

  function labels(names, boxes) {
    const panes = by("panes");
    if (panes.childElementCount !== names.length) panes.replaceChildren(...names.map(() => make("div", { className: "pane" })));
    names.forEach((name, number) => {
      const shown = meta.shown.find((one) => one.name === name), pane = panes.children[number];
      const [left, top, width, height] = boxes[number];
      Object.assign(pane.style, { left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${height}px` });
      pane.className = `pane${names.length > 1 ? " more" : ""}${names.length > 2 ? " crowded" : ""}${names.length > 1 && state.layout !== "all" && number === state.active ? " active" : ""}`;
      if (pane.dataset.name === `${meta.number} ${name}`) return;
      pane.dataset.name = `${meta.number} ${name}`;
      const n = shown.triangles.toLocaleString("en"), of = shown.of.toLocaleString("en");
      const size = shown.kind === "points" ? `${n} of ${of} measured points`
        : shown.of === 0 ? "no surface: nothing is inside" : shown.of > shown.triangles ? `${n} triangles, simplified from ${of}` : `${n} triangles`;
      const mean = shown.mean === null ? "" : `mean distance to the ground truth ${ocnf.number(shown.mean)} mm`;
      pane.replaceChildren(make("div", {}, make("b", {}, name), make("small", {}, shown.caption),
        make("small", { className: "size" }, size), make("small", {}, mean)));
    });
  }

  function say(text) {
    by("message").textContent = text;
    by("message").hidden = !text;
  }

  // ---- drawing, when something has changed

  const clipPlace = () => (state.place / 1000 - 0.5) * ocnf.page.scale.extent;

  function draw() {
    if (isWaiting || broken || !renderer) return;
    isWaiting = true;
    requestAnimationFrame(() => { isWaiting = false; paint(); });
  }

  function paint() {
    const width = by("stage").clientWidth, height = by("stage").clientHeight;
    if (!width || !height) return;
    const ratio = Math.min(devicePixelRatio, 2);
    const size = renderer.getSize(new THREE.Vector2()).toArray();
    if (size[0] !== width || size[1] !== height || renderer.getPixelRatio() !== ratio) {
      renderer.setPixelRatio(ratio);
      renderer.setSize(width, height, false);
    }
    renderer.setClearColor(getComputedStyle(document.documentElement).getPropertyValue("--stage").trim(), 1);
    renderer.setScissorTest(false);
    renderer.clear();
    const names = paneNames(), boxes = paneBoxes(names.length);
    labels(names, boxes);
    box.visible = state.box;
    if (state.axis) {
      const sign = state.flip ? 1 : -1;
      plane.normal.set(...AXES.map((axis) => (axis === state.axis ? sign : 0)));
      plane.constant = -sign * clipPlace();
    }
    const clipping = state.axis ? [plane] : [];
    const toCamera = camera.position.clone().sub(controls.target);
    const right = new THREE.Vector3().crossVectors(camera.up, toCamera).normalize();
    light.target.position.copy(controls.target);
    light.position.copy(camera.position).addScaledVector(right, -0.55 * toCamera.length()).addScaledVector(camera.up, 0.7 * toCamera.length());
    renderer.setScissorTest(true);
    names.forEach((name, number) => {
      for (const one of items) {
        one.group.visible = one.shown.name === name;
        if (!one.group.visible) continue;
        for (const part of one.parts) part.material = state.error ? one.coloured : one.plain;
        const lines = state.wireframe ? linesOf(one) : one.lines;
        if (lines) lines.visible = state.wireframe;
        for (const part of one.group.children) part.material.clippingPlanes = clipping;
      }
      const [left, top, w, h] = boxes[number];
      renderer.setViewport(left, height - top - h, w, h);
      renderer.setScissor(left, height - top - h, w, h);
      // A narrow pane sees as much across as a wide one sees up and down.
      camera.aspect = w / h;
      camera.fov = w < h ? (360 / Math.PI) * Math.atan(Math.tan((FIELD * Math.PI) / 360) * (h / w)) : FIELD;
      camera.updateProjectionMatrix();
      // three.js takes the size of points for one in a field of 90 degrees over the whole canvas.
      const spread = Math.tan((camera.fov * Math.PI) / 360) * (height / h);
      for (const one of items.filter((each) => each.shown.kind === "points")) {
        one.plain.size = one.coloured.size = ocnf.page.scale.extent / POINTS_ACROSS / spread;
      }
      renderer.render(scene, camera);
    });
    camera.fov = FIELD;
    gizmo();
    document.documentElement.dataset.drawn = String(Number(document.documentElement.dataset.drawn || 0) + 1);
  }

  function gizmo() {
    const colours = ["#c0504d", "#4f9a55", "#4a78b8"];
    const lines = AXES.map((axis, number) => {
      const way = new THREE.Vector3(...AXES.map((other) => (other === axis ? 1 : 0))).transformDirection(camera.matrixWorldInverse);
      return { axis, colour: colours[number], x: way.x, y: -way.y, z: way.z };
    }).sort((a, b) => a.z - b.z);
    by("gizmo").innerHTML = lines.map(({ axis, colour, x, y }) => `<line x2="${(19 * x).toFixed(1)}" y2="${(19 * y).toFixed(1)}" stroke="${colour}"/>`
      + `<text x="${(25 * x).toFixed(1)}" y="${(25 * y).toFixed(1)}">${axis}</text>`).join("");
  }

  // ---- mouse and keys

  for (const button of by("layout").children) button.onclick = () => { state.layout = button.dataset.layout; refresh(); };
  for (const id of ["error", "wireframe", "box"]) by(id).onchange = () => { state[id] = by(id).checked; refresh(); };
  by("clip-axis").onchange = () => { state.axis = by("clip-axis").value; refresh(); };
  by("clip-place").oninput = () => { state.place = Number(by("clip-place").value); refresh(); };
  by("clip-flip").onchange = () => { state.flip = by("clip-flip").checked; refresh(); };
  by("reset").onclick = reset;
  by("canvas").addEventListener("pointerdown", (event) => {
    const names = paneNames();
    const pane = paneBoxes(names.length).findIndex(([left, top, width, height]) => event.offsetX >= left && event.offsetX < left + width
      && event.offsetY >= top && event.offsetY < top + height);
    if (state.layout === "2" && pane >= 0 && pane !== state.active) { state.active = pane; refresh(); }
  });
  by("canvas").addEventListener("contextmenu", (event) => event.preventDefault());

  // What a key does while a sample is open; false: nothing.
  ocnf.viewer.key = (key) => {
    const next = (values, value) => values[(values.indexOf(value) + 1) % values.length];
    const shown = meta?.shown[Number(key) - 1];
    if (shown) choose(shown.name);
    else if (key === "e") state.error = !state.error;
    else if (key === "w") state.wireframe = !state.wireframe;
    else if (key === "b") state.box = !state.box;
    else if (key === "c") state.axis = next(["", ...AXES], state.axis);
    else if (key === "s") state.layout = next(["1", "2", "all"], state.layout);
    else if (key === "r") reset();
    else return false;
    refresh();
    return true;
  };
})();
