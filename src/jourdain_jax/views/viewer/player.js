// Puts bodies, ground, paths and forces into a three.js scene, and plays them. Everything that is drawn comes from the page: its JSON says what there is,
// runs of 32-bit floats say where it is. three.js has y up by default; here z is up, lengths are in metres.
"use strict";

const $ = (id) => document.getElementById(id);

async function inflated(id) {
  const bytes = Uint8Array.from(atob($(id).textContent), (c) => c.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
}

function shade(geometry, dark) {
  // one brightness per triangle, by its middle
  const flat = geometry.index ? geometry.toNonIndexed() : geometry, at = flat.attributes.position, light = new Float32Array(3 * at.count);
  for (let i = 0; i < at.count; i += 3) {
    const mid = [0, 1, 2].map((k) => (at.getComponent(i, k) + at.getComponent(i + 1, k) + at.getComponent(i + 2, k)) / 3);
    light.fill(1 - dark(mid), 3 * i, 3 * i + 9);
  }
  flat.setAttribute("color", new THREE.BufferAttribute(light, 3));
  return flat;
}

function geometryOf(shape, numbers) {
  const s = shape.size;
  const upright = (g) => g.rotateX(Math.PI / 2); // three's cylinders stand along y
  if (shape.kind === "ellipsoid") return shade(upright(new THREE.SphereGeometry(1, 48, 32)), ([x, y, z]) => (x * y * z > 0 ? 0.3 : 0)).scale(...s);
  if (shape.kind === "box") return shade(new THREE.BoxGeometry(...s), () => 0);
  if (shape.kind === "cylinder") return shade(upright(new THREE.CylinderGeometry(s[0], s[0], s[1], 48)), () => 0);
  if (shape.kind === "capsule") return shade(upright(new THREE.CapsuleGeometry(s[0], s[1], 12, 32)), () => 0);
  if (shape.kind === "wheel") {
    const tread = ([x, y]) => (Math.hypot(x, y) > 0.9 * s[0] ? 0.4 : x * y > 0 ? 0.25 : 0); // a dark tyre around quarters
    const profile = [[0, -0.35], [0.88, -0.35], [0.9, -0.5], [0.97, -0.5], [1, -0.3], [1, 0.3], [0.97, 0.5], [0.9, 0.5], [0.88, 0.35], [0, 0.35]];
    const lathe = new THREE.LatheGeometry(profile.map(([r, z]) => new THREE.Vector2(r * s[0], z * s[1])), 64).toNonIndexed();
    lathe.computeVertexNormals();
    return shade(upright(lathe), tread);
  }
  const corners = numbers(shape.mesh), mesh = new THREE.BufferGeometry();
  mesh.setAttribute("position", new THREE.BufferAttribute(corners.slice(), 3));
  mesh.computeVertexNormals();
  return shade(mesh, () => 0);
}

function edgesOf(geometry, colour) {
  // lines along sharp edges, lighter than a dark body and darker than a light one
  const ink = new THREE.Color(colour), bright = 0.3 * ink.r + 0.6 * ink.g + 0.1 * ink.b; // linear, 0 to 1
  ink.lerp(new THREE.Color(bright < 0.2 ? "#ffffff" : "#000000"), 0.4);
  return new THREE.LineSegments(new THREE.EdgesGeometry(geometry, 30), new THREE.LineBasicMaterial({ color: ink }));
}

function axesOf(length) {
  // arrows along x (red), y (green) and z (blue), seen through bodies
  const axes = new THREE.Group(), tips = [["#d62728", [0, 0, -Math.PI / 2]], ["#2ca02c", [0, 0, 0]], ["#1f77b4", [Math.PI / 2, 0, 0]]];
  for (const [colour, turn] of tips) {
    const look = new THREE.MeshStandardMaterial({ color: colour, roughness: 0.6, depthTest: false, transparent: true }), arrow = new THREE.Group();
    const shaft = new THREE.Mesh(new THREE.CylinderGeometry(0.02, 0.02, 0.8, 12), look), head = new THREE.Mesh(new THREE.ConeGeometry(0.06, 0.2, 16), look);
    shaft.position.y = 0.4;
    head.position.y = 0.9;
    shaft.renderOrder = head.renderOrder = 7;
    arrow.add(shaft, head);
    arrow.rotation.set(...turn);
    axes.add(arrow);
  }
  axes.scale.setScalar(length);
  axes.visible = false;
  return axes;
}

class Motion {
  // One motion: groups of shapes that move together, bars that stretch, paths that grow, and arrows.
  constructor(data, page, numbers, scene, ghost) {
    this.data = data;
    this.ts = numbers(data.ts);
    this.groups = [];
    this.bars = [];
    this.bodies = new Map(); // by name
    this.axes = [];
    const material = (colour, opacity) => {
      const clear = opacity * (ghost ? 0.3 : 1);
      const glass = { transparent: clear < 1, opacity: clear, depthWrite: clear === 1 };
      return new THREE.MeshStandardMaterial({ color: colour, roughness: 0.65, vertexColors: true, side: THREE.DoubleSide, ...glass });
    };
    const rod = shade(new THREE.CylinderGeometry(1, 1, 1, 16).rotateX(Math.PI / 2), () => 0), knob = shade(new THREE.SphereGeometry(1, 16, 12), () => 0);
    for (const body of data.bodies) {
      const group = new THREE.Group(), axes = axesOf(page.arrow);
      scene.add(group);
      this.bodies.set(body.name, group);
      if (body.name && !ghost) { group.add(axes); this.axes.push(axes); }
      this.groups.push({ group, p: numbers(body.p), q: numbers(body.q), turns: numbers(body.turns) });
      for (const shape of body.shapes) {
        const look = material(shape.colour, shape.opacity);
        const put = (geometry) => {
          const mesh = new THREE.Mesh(geometry, look);
          mesh.castShadow = !ghost && shape.opacity === 1;
          group.add(mesh);
          return mesh;
        };
        if (shape.kind !== "line") {
          const geometry = geometryOf(shape, numbers), mesh = put(geometry);
          if (!ghost && shape.opacity === 1) mesh.add(edgesOf(geometry, shape.colour));
          this.groups.push({ group: mesh, p: numbers(shape.p), q: numbers(shape.q), turns: [0] });
          continue;
        }
        const all = numbers(shape.points), count = shape.count;
        for (let k = 0; k < count; k++) {
          const ball = put(knob);
          ball.scale.setScalar(shape.radius);
          this.bars.push({ mesh: ball, all, count, from: k, to: k });
          if (k + 1 < count) this.bars.push({ mesh: put(rod), all, count, from: k, to: k + 1, radius: shape.radius });
        }
      }
    }
    this.paths = data.paths.map((path) => {
      const [line] = [ghost ? 0.35 : 1, 0.2].map((opacity) => { // what was gone through, and all of it, pale
        const geometry = new THREE.LineGeometry(), look = { color: path.colour, linewidth: 2.5, transparent: true, opacity, depthWrite: false };
        geometry.setPositions(numbers(path.points));
        const one = new THREE.Line2(geometry, new THREE.LineMaterial(look));
        one.frustumCulled = false;
        scene.add(one);
        return one;
      });
      return line;
    });
    this.arrows = data.forces.map((force) => {
      const red = new THREE.MeshStandardMaterial({ color: "#c0188a", roughness: 0.6, depthTest: false, transparent: true }), group = new THREE.Group();
      const shaft = new THREE.Mesh(new THREE.CylinderGeometry(1, 1, 1, 12).rotateX(Math.PI / 2), red);
      const head = new THREE.Mesh(new THREE.ConeGeometry(1, 1, 20).rotateX(Math.PI / 2), red);
      shaft.renderOrder = 8; // forces are seen through the bodies they act on
      head.renderOrder = 9;
      group.add(shaft, head);
      scene.add(group);
      return { group, shaft, head, points: numbers(force.points), vectors: numbers(force.vectors), thick: page.thickness };
    });
  }

  moment(t) {
    // number of the interval that holds t, and how far into it
    const ts = this.ts, last = ts.length - 1, sign = ts[last] < ts[0] ? -1 : 1;
    let low = 0, high = last;
    if (last === 0) return [0, 0];
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (sign * (t - ts[middle]) >= 0) low = middle; else high = middle;
    }
    return [low, Math.min(1, Math.max(0, (t - ts[low]) / (ts[low + 1] - ts[low])))];
  }

  show(t) {
    const [i, s] = this.moment(t);
    const at = (all, count = 1, k = 0) => {
      const still = all.length === 3 * count, a = still ? 3 * k : 3 * (i * count + k), b = still || s === 0 ? a : a + 3 * count;
      return new THREE.Vector3(all[a] + s * (all[b] - all[a]), all[a + 1] + s * (all[b + 1] - all[a + 1]), all[a + 2] + s * (all[b + 2] - all[a + 2]));
    };
    for (const { group, p, q, turns } of this.groups) {
      group.position.copy(at(p));
      const four = (j) => new THREE.Quaternion(q[j], q[j + 1], q[j + 2], q[j + 3]);
      if (q.length === 4) { group.quaternion.copy(four(0)); continue; }
      group.quaternion.copy(four(4 * i));
      if (s > 0) {
        // the turn from one saved time to the next, with the whole turns that a fast wheel makes between them
        const step = four(4 * i + 4).multiply(four(4 * i).invert());
        const axis = new THREE.Vector3(step.x, step.y, step.z), sine = axis.length();
        const angle = 2 * Math.atan2(sine, step.w) + 2 * Math.PI * (turns[Math.min(i, turns.length - 1)] || 0);
        if (sine > 1e-9) group.quaternion.premultiply(new THREE.Quaternion().setFromAxisAngle(axis.divideScalar(sine), s * angle));
      }
    }
    for (const { mesh, all, count, from, to, radius } of this.bars) {
      const a = at(all, count, from), b = at(all, count, to);
      mesh.position.copy(a).add(b).multiplyScalar(0.5);
      if (from === to) continue;
      const along = b.sub(a), length = along.length();
      mesh.visible = length > 0;
      mesh.scale.set(radius, radius, length || 1);
      if (length > 0) mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), along.divideScalar(length));
    }
    for (const { group, shaft, head, points, vectors, thick } of this.arrows) {
      const v = at(vectors), length = v.length(), tip = Math.min(length, 4 * thick);
      group.visible = length > 0.5 * thick;
      group.position.copy(at(points));
      if (!group.visible) continue;
      group.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), v.divideScalar(length));
      shaft.scale.set(0.55 * thick, 0.55 * thick, Math.max(length - tip, 1e-9));
      shaft.position.set(0, 0, (length - tip) / 2);
      head.scale.set(1.4 * thick, 1.4 * thick, tip);
      head.position.set(0, 0, length - tip / 2);
    }
    this.paths.forEach((line) => { line.geometry.instanceCount = i + (s > 0.5 ? 1 : 0); });
  }

  middle() {
    const middle = new THREE.Vector3(), bodies = this.data.bodies.map((body, k) => [body, k]).filter(([body]) => body.moves);
    const own = this.groups.filter((g) => g.group.parent && g.group.isGroup);
    bodies.forEach(([, k]) => middle.add(own[k].group.position));
    return bodies.length ? middle.divideScalar(bodies.length) : middle;
  }
}

function groundOf(ground, page, numbers) {
  if (ground.kind !== "plane") {
    const glass = { color: "#c9c9c2", transparent: true, opacity: 0.5, side: THREE.DoubleSide, depthWrite: false };
    return new THREE.Mesh(geometryOf(ground, numbers), new THREE.MeshStandardMaterial(glass));
  }
  const tile = document.createElement("canvas");
  tile.width = tile.height = 256;
  const ink = tile.getContext("2d");
  ink.fillStyle = "#f1f1ec";
  ink.fillRect(0, 0, 256, 256);
  ink.fillStyle = "#e9e9e3";
  ink.fillRect(0, 0, 128, 128);
  ink.fillRect(128, 128, 128, 128);
  const texture = new THREE.CanvasTexture(tile), side = page.ground;
  texture.colorSpace = THREE.SRGBColorSpace;
  texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
  texture.anisotropy = 8;
  texture.repeat.set(side / (2 * page.tile), side / (2 * page.tile));
  const behind = { polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 8 }; // lines on the ground are seen whole
  const plane = new THREE.Mesh(new THREE.PlaneGeometry(side, side), new THREE.MeshLambertMaterial({ map: texture, side: THREE.DoubleSide, ...behind }));
  plane.receiveShadow = true;
  plane.position.set(...ground.p);
  plane.quaternion.set(...ground.q);
  return plane;
}

async function main() {
  const page = JSON.parse($("scene").textContent), floats = new Float32Array(await inflated("numbers"));
  const numbers = ([first, count]) => floats.subarray(first, first + count);
  const script = document.createElement("script");
  script.textContent = new TextDecoder().decode(await inflated("three")) + ";globalThis.THREE=THREE;";
  document.head.append(script);

  const canvas = $("view"), renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
  renderer.shadowMap.enabled = true;
  renderer.shadowMap.type = THREE.PCFShadowMap;
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(35, 1, page.size / 100, 3 * page.ground);
  scene.background = new THREE.Color("#fbfbf9");
  scene.fog = new THREE.Fog("#fbfbf9", 1, 2);
  camera.up.set(0, 0, 1);
  scene.add(new THREE.HemisphereLight("#ffffff", "#b4b4ac", 2.0));
  const sun = new THREE.DirectionalLight("#ffffff", 1.6);
  sun.castShadow = true;
  sun.shadow.mapSize.set(2048, 2048);
  sun.shadow.bias = -0.0005;
  sun.shadow.normalBias = 0.02;
  scene.add(sun, sun.target);
  const lamp = new THREE.DirectionalLight("#ffffff", 0.9); // at the eye
  camera.add(lamp);
  lamp.position.set(0, 0, 1);
  scene.add(camera);
  page.grounds.forEach((ground) => scene.add(groundOf(ground, page, numbers)));
  const motions = page.motions.map((data, k) => new Motion(data, page, numbers, scene, k > 0));
  const controls = new THREE.OrbitControls(camera, canvas), space = axesOf(1.5 * page.arrow);
  scene.add(space);

  $("labels").querySelector("h1").textContent = page.title;
  for (const { name, colour } of page.names) {
    const entry = document.createElement("label"), box = document.createElement("input"), chip = document.createElement("i");
    Object.assign(box, { type: "checkbox", checked: true });
    box.onchange = () => {
      entry.classList.toggle("hidden", !box.checked);
      motions.forEach(({ bodies }) => { if (bodies.has(name)) bodies.get(name).visible = box.checked; });
      draw();
    };
    chip.style.background = colour;
    entry.title = "hide or show";
    entry.append(box, chip, name);
    $("names").append(entry);
  }
  $("note").textContent = page.note;

  const [begin, end] = page.span, forward = end >= begin ? 1 : -1;
  const asked = new URLSearchParams(location.hash.slice(1)); // ride.html#t=2.5 opens there
  let now = asked.has("t") ? Number(asked.get("t")) : begin, playing = false, before = null, last = null;
  $("scrub").min = Math.min(begin, end);
  $("scrub").max = Math.max(begin, end);
  $("follow").checked = page.follow;

  function aim() {
    // far enough back that the box, or in following its part that moves along, fills the view
    const follow = $("follow").checked, box = follow ? page.near : page.far;
    const low = new THREE.Vector3(...box[0]), high = new THREE.Vector3(...box[1]), middle = low.clone().add(high).multiplyScalar(0.5);
    const [e, a] = page.view.map((x) => (x * Math.PI) / 180);
    const towards = new THREE.Vector3(Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e));
    if (follow) middle.add(motions[0].middle());
    camera.position.copy(middle).add(towards);
    camera.lookAt(middle);
    camera.updateMatrixWorld();
    const right = new THREE.Vector3().setFromMatrixColumn(camera.matrixWorld, 0), up = new THREE.Vector3().setFromMatrixColumn(camera.matrixWorld, 1);
    const half = Math.tan((camera.fov * Math.PI) / 360), labels = 64 / Math.max($("stage").clientHeight, 200); // the part of the height that they take
    const tall = half * (1 - labels), wide = half * camera.aspect;
    let distance = 0;
    for (let k = 0; k < 8; k++) {
      const corner = new THREE.Vector3(k & 1 ? high.x : low.x, k & 2 ? high.y : low.y, k & 4 ? high.z : low.z);
      if (follow) corner.add(motions[0].middle());
      corner.sub(middle);
      distance = Math.max(distance, Math.abs(corner.dot(right)) / wide + corner.dot(towards), Math.abs(corner.dot(up)) / tall + corner.dot(towards));
    }
    middle.addScaledVector(up, half * labels * distance);
    camera.position.copy(middle).addScaledVector(towards, 1.1 * distance);
    controls.target.copy(middle);
    last = motions[0].middle();
    controls.update();
  }

  function draw() {
    motions.forEach((motion) => motion.show(now));
    if ($("follow").checked && last !== null) {
      const moved = motions[0].middle().sub(last);
      camera.position.add(moved);
      controls.target.add(moved);
    }
    last = motions[0].middle();
    const away = camera.position.distanceTo(controls.target), span = Math.max(1.5 * page.size, Math.min(page.reach, away));
    sun.target.position.copy(controls.target);
    sun.position.copy(controls.target).add(new THREE.Vector3(-0.5, -0.7, 1.6).multiplyScalar(2 * span));
    Object.assign(sun.shadow.camera, { left: -span, right: span, top: span, bottom: -span, near: span / 10, far: 8 * span });
    sun.shadow.camera.updateProjectionMatrix();
    scene.fog.near = 2.5 * away;
    scene.fog.far = 9 * away;
    $("scrub").value = now;
    $("time").textContent = `t = ${now.toFixed(2)} s`;
    renderer.render(scene, camera);
  }

  function fit() {
    const { clientWidth: width, clientHeight: height } = $("stage");
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    renderer.setSize(width, height, false);
    camera.aspect = width / Math.max(height, 1);
    camera.updateProjectionMatrix();
  }

  function tick(clock) {
    if (!playing) return;
    now += forward * Number($("speed").value) * (before === null ? 0 : (clock - before) / 1000);
    before = clock;
    if (forward * (now - end) > 0) now = begin;
    draw();
    requestAnimationFrame(tick);
  }

  function play(on) {
    playing = on;
    before = null;
    $("play").textContent = on ? "Pause" : "Play";
    if (on) requestAnimationFrame(tick);
  }

  fit();
  motions.forEach((motion) => motion.show(now));
  aim();
  draw();
  controls.addEventListener("change", () => playing || draw());
  new ResizeObserver(() => { fit(); draw(); }).observe($("stage"));
  $("play").onclick = () => play(!playing);
  $("scrub").oninput = () => { play(false); now = Number($("scrub").value); draw(); };
  $("reset").onclick = () => { aim(); draw(); };
  $("follow").onchange = () => { aim(); draw(); };
  $("axes").onchange = () => { [space, ...motions[0].axes].forEach((axes) => { axes.visible = $("axes").checked; }); draw(); };
  $("help").onclick = () => { $("keys").hidden = !$("keys").hidden; };
  $("save").onclick = () => {
    draw();
    Object.assign(document.createElement("a"), { href: canvas.toDataURL("image/png"), download: `${page.title}.png` }).click();
  };
  const step = (by) => { play(false); now = Math.min(Math.max(now + by * (end - begin) / 50, Math.min(begin, end)), Math.max(begin, end)); draw(); };
  const keys = {
    " ": () => play(!playing), ArrowLeft: () => step(-1), ArrowRight: () => step(1), "?": () => $("help").click(),
    f: () => $("follow").click(), a: () => $("axes").click(), r: () => $("reset").click(), p: () => $("save").click(),
  };
  document.onkeydown = (event) => {
    if (!(event.key in keys) || event.ctrlKey || event.metaKey || ["BUTTON", "SELECT"].includes(event.target.tagName)) return;
    event.preventDefault();
    keys[event.key]();
  };
  if (page.play) play(true);
  document.body.dataset.ready = "yes";
}

main().catch((error) => { $("note").textContent = `This view needs a browser with WebGL and DecompressionStream: ${error.message}`; });
