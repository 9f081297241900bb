// The cell in three dimensions: draws what fleet/arm/cell.py describes, with three.js.
// One instanced mesh per shape of a link, with one instance per arm: the number of draws does not grow with the fleet.
"use strict";

// Whether WebGL has no graphics card: smooth edges would then cost more time than all else.
function drawnBySoftware() {
  const gl = document.createElement("canvas").getContext("webgl");
  const info = gl && gl.getExtension("WEBGL_debug_renderer_info");
  return Boolean(info) && /swiftshader|llvmpipe|software/i.test(gl.getParameter(info.UNMASKED_RENDERER_WEBGL));
}

const STANDING_M = 0.7, MARGIN_M = 0.15; // length of an arm along its mount in most postures; room round it

const SCALE_PX = 44; // height of the strip with the scale, below the picture: names of arms cannot cover it

// The colour scale of the motors, with its limits.
function makeScale({ colours, marks_c, warning_c, error_c }) {
  const bar = document.createElement("div"), first = marks_c[0], all = marks_c[marks_c.length - 1] - first;
  const share = (tempC) => `${(100 * (tempC - first)) / all}%`, names = { [warning_c]: "warning", [error_c]: "error" };
  bar.className = "scale";
  bar.style.background = `linear-gradient(to right, ${colours.map((colour, i) => `${colour} ${share(marks_c[i])}`).join(", ")})`;
  for (const mark of marks_c.slice(0, -1)) {
    const label = document.createElement("span");
    label.textContent = mark === first ? `${mark} °C` : mark;
    label.title = names[mark] || "";
    label.style.left = share(mark);
    bar.append(label);
  }
  bar.title = `Motor temperature: warning limit ${warning_c} °C, error limit ${error_c} °C`;
  return bar;
}

function makeCell(place, model) {
  const arms = model.arms.length, turning = model.links.filter((link) => link.turns).length;
  const scene = new THREE.Scene(), renderer = new THREE.WebGLRenderer({ antialias: !drawnBySoftware() });
  const camera = new THREE.PerspectiveCamera(40, 1, 0.05, 200);
  camera.up.set(0, 0, 1);
  place.append(renderer.domElement, makeScale(model.heat));
  renderer.outputEncoding = THREE.sRGBEncoding;
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const ground = () => {
    scene.background = new THREE.Color(dark.matches ? "#16181b" : "#f3f4f5");
    floor.material.opacity = dark.matches ? 0.3 : 1;
    changed = true;
  };
  scene.add(new THREE.HemisphereLight("#ffffff", "#9a9a9a", 0.85));
  const sun = new THREE.DirectionalLight("#ffffff", 0.5);
  sun.position.set(2, -3, 6);
  scene.add(sun);

  const vector = (values) => new THREE.Vector3(...values);
  const pose = (what, scale) => new THREE.Matrix4().compose(
    vector(what.position), new THREE.Quaternion(what.quaternion[1], what.quaternion[2], what.quaternion[3],
      what.quaternion[0]), scale || new THREE.Vector3(1, 1, 1));
  const material = (colour, opacity = 1, more) => new THREE.MeshLambertMaterial({ color: colour, opacity, transparent: opacity < 1, ...more });
  const colourOf = (rgb) => new THREE.Color(...rgb).convertSRGBToLinear();

  const decoded = (text, Kind) => new Kind(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  const surfaces = model.meshes.map((mesh) => {
    const surface = new THREE.BufferGeometry();
    surface.setAttribute("position", new THREE.BufferAttribute(decoded(mesh.points, Float32Array), 3));
    surface.setIndex(new THREE.BufferAttribute(decoded(mesh.triangles, Uint32Array), 1));
    surface.computeVertexNormals();
    return surface;
  });

  function geometry(shape) {
    if (shape.kind === "mesh") return surfaces[shape.mesh];
    const [a, b, c] = shape.size;
    switch (shape.kind) {
      case "sphere": return new THREE.SphereGeometry(a, 14, 9);
      case "capsule": return new THREE.CapsuleGeometry(a, 2 * b, 3, 12).rotateX(Math.PI / 2);
      case "cylinder": return new THREE.CylinderGeometry(a, a, 2 * b, 14).rotateX(Math.PI / 2);
      default: return new THREE.BoxGeometry(2 * a, 2 * b, 2 * c);
    }
  }

  function instanced(shape, colour, opacity = 1, count = arms) {
    const mesh = new THREE.InstancedMesh(shape, material(colour, opacity), count);
    mesh.frustumCulled = false;
    scene.add(mesh);
    return mesh;
  }

  const links = model.links.map((link) => ({
    parent: link.parent, turns: link.turns, local: pose(link),
    shapes: link.shapes.map((shape) => ({ local: pose(shape), mesh: instanced(geometry(shape), colourOf(shape.colour)) })),
    motor: link.turns ? instanced(new THREE.CylinderGeometry(1, 1, 2 * model.motor.half_length, 20).rotateX(Math.PI / 2), "#ffffff") : null, // a drum round the axis of the joint
  }));
  const hand = pose(model.hand), load = instanced(new THREE.SphereGeometry(1, 14, 9), colourOf(model.load.colour));
  const mounts = model.arms.map((arm) => pose(arm));
  const points = mounts.flatMap((mount) => [0, STANDING_M].map((z) => new THREE.Vector3(0, 0, z).applyMatrix4(mount)));
  for (const one of model.places) {
    points.push(vector(one.position));
    const mark = new THREE.Mesh(new THREE.OctahedronGeometry(0.03), material(colourOf(one.colour)));
    mark.applyMatrix4(pose(one));
    scene.add(mark);
  }
  for (const one of model.fixtures) {
    const shape = "mesh" in one ? surfaces[one.mesh].toNonIndexed() : new THREE.BoxGeometry(...one.size);
    shape.computeVertexNormals(); // without shared points: triangles are flat
    const solid = new THREE.Mesh(shape, material(colourOf(one.colour), 1, { side: THREE.DoubleSide })); // it may be open
    solid.applyMatrix4(pose(one));
    points.push(vector(one.position));
    scene.add(solid);
  }
  for (const look of new Set(model.supports.map((one) => String(one.colour)))) {
    const alike = model.supports.filter((one) => String(one.colour) === look), [red, green, blue, opacity] = alike[0].colour;
    const boxes = instanced(new THREE.BoxGeometry(1, 1, 1), colourOf([red, green, blue]), opacity, alike.length);
    alike.forEach((one, i) => boxes.setMatrixAt(i, pose(one, vector(one.size))));
  }
  const box = new THREE.Box3().setFromPoints(points);
  const across = Math.max(1, ...box.getSize(new THREE.Vector3()).toArray());
  const floor = new THREE.GridHelper(Math.ceil(across + 3), Math.ceil(across + 3) * 2, "#9aa0a6", "#c3c7cb");
  floor.rotation.x = Math.PI / 2;
  floor.material.transparent = true;
  const centre = box.getCenter(new THREE.Vector3());
  floor.position.set(centre.x, centre.y, Math.min(0, box.min.z) - 0.002);
  scene.add(floor);

  function label(text) {
    const canvas = document.createElement("canvas"), pen = canvas.getContext("2d"), font = "600 40px system-ui, sans-serif";
    pen.font = font;
    canvas.width = Math.min(600, pen.measureText(text).width + 24);
    canvas.height = 56;
    pen.font = font;
    pen.fillStyle = "rgba(255,255,255,.82)";
    pen.fillRect(0, 0, canvas.width, canvas.height);
    pen.fillStyle = "#222";
    pen.fillText(text, 12, 42, canvas.width - 24);
    const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map: new THREE.CanvasTexture(canvas), depthTest: false }));
    sprite.scale.set((0.09 * canvas.width) / canvas.height, 0.09, 1);
    return sprite;
  }
  const named = arms <= 40;
  if (named) model.arms.forEach((arm) => {
    const sprite = label(arm.name);
    sprite.position.copy(vector(arm.position)).add(new THREE.Vector3(0, 0, -0.08).applyMatrix4(
      new THREE.Matrix4().extractRotation(pose(arm))));
    scene.add(sprite);
  });

  // Colours between the marks of the scale.
  const marks = model.heat.marks_c, scale = model.heat.colours.map((colour) => new THREE.Color(colour));
  function heatColour(tempC) {
    let i = 1;
    while (i < marks.length - 1 && tempC > marks[i]) i++;
    const share = Math.min(1, Math.max(0, (tempC - marks[i - 1]) / (marks[i] - marks[i - 1])));
    return new THREE.Color().lerpColors(scale[i - 1], scale[i], share).convertSRGBToLinear();
  }
  // A hotter motor is also larger, for people who see no colours.
  const { cool_m, hot_m } = model.motor;
  const radius = (tempC) => cool_m + (hot_m - cool_m) * Math.min(1, Math.max(0, (tempC - marks[0]) / (model.heat.error_c - marks[0])));

  const radii = new Float32Array(arms * turning).fill(radius(marks[0]));
  const work = new THREE.Matrix4(), turn = new THREE.Matrix4();
  const posed = new Uint8Array(arms);
  let changed = true;

  // Angles of an arm's joints, rad.
  function setPose(arm, q, loadM) {
    const at = [];
    let joint = 0;
    for (const link of links) {
      const here = new THREE.Matrix4().multiplyMatrices(link.parent < 0 ? mounts[arm] : at[link.parent], link.local);
      if (link.turns) {
        here.multiply(turn.makeRotationZ(q[joint]));
        const size = radii[arm * turning + joint++];
        link.motor.setMatrixAt(arm, work.copy(here).scale(new THREE.Vector3(size, size, size)));
        link.motor.instanceMatrix.needsUpdate = true;
      }
      at.push(here);
      for (const shape of link.shapes) {
        shape.mesh.setMatrixAt(arm, work.multiplyMatrices(here, shape.local));
        shape.mesh.instanceMatrix.needsUpdate = true;
      }
    }
    const held = Math.max(loadM || 0, 1e-6);
    work.multiplyMatrices(at[at.length - 1], hand).multiply(turn.makeTranslation(0, 0, held));
    load.setMatrixAt(arm, work.scale(new THREE.Vector3(held, held, held)));
    load.instanceMatrix.needsUpdate = true;
    changed = true;
    if (posed[arm] < 2 && ++posed[arm] === 2) { // the first posture after that of `makeCell`: it belongs into the view
      points.push(...at.map((link) => new THREE.Vector3().setFromMatrixPosition(link)));
      if (!view.distance) look();
    }
  }

  // Temperatures of an arm's motors, °C; shown with the next pose.
  function setHeat(arm, tempC) {
    let joint = 0;
    for (const link of links) if (link.turns) {
      radii[arm * turning + joint] = radius(tempC[joint]);
      link.motor.setColorAt(arm, heatColour(tempC[joint++]));
      link.motor.instanceColor.needsUpdate = true;
    }
  }

  // 0 idle, 1 working, 2 faulted, -1 absent: a faulted arm is red, an absent one dark.
  const shades = { "-1": [0.35, 0.35, 0.37], 0: [1, 1, 1], 1: [1, 1, 1], 2: [1, 0.45, 0.42] };
  function setMode(arm, mode) {
    const colour = colourOf(shades[mode] || shades[0]);
    for (const link of links) for (const shape of link.shapes) {
      shape.mesh.setColorAt(arm, colour);
      shape.mesh.instanceColor.needsUpdate = true;
    }
  }

  // The camera goes round a target: drag to turn, shift-drag or two fingers to move, wheel or pinch to zoom.
  const target = centre.clone(), start = { azimuth: -0.9, height: 0.5, distance: null }; // null: the whole cell fills the view
  let view = { ...start }, distance = 1, fingers = new Map(), spread = 0;
  // Distance from which the whole cell fills the view; moves the target to the middle of what the view shows.
  function fit(towards) {
    const side = new THREE.Vector3(0, 0, 1).cross(towards).normalize(), up = towards.clone().cross(side);
    const high = Math.tan((camera.fov * Math.PI) / 360), wide = high * camera.aspect;
    target.copy(centre);
    for (let again = 0; again < 4; again++) {
      const at = points.map((point) => point.clone().sub(target));
      distance = Math.max(...at.map((each) => each.dot(towards)
        + Math.max((Math.abs(each.dot(side)) + MARGIN_M) / wide, (Math.abs(each.dot(up)) + MARGIN_M) / high)));
      for (const axis of [side, up]) {
        const shown = at.map((each) => each.dot(axis) / (distance - each.dot(towards)));
        target.addScaledVector(axis, ((Math.max(...shown) + Math.min(...shown)) / 2) * distance);
      }
    }
  }
  function look() {
    const { azimuth, height } = view;
    const towards = new THREE.Vector3(Math.cos(azimuth) * Math.cos(height), Math.sin(azimuth) * Math.cos(height), Math.sin(height));
    if (view.distance) distance = view.distance;
    else fit(towards);
    camera.position.copy(towards).multiplyScalar(distance).add(target);
    camera.lookAt(target);
    changed = true;
  }
  function rotate(dx, dy) {
    view.azimuth -= dx * 0.008;
    view.height = Math.min(1.5, Math.max(-0.2, view.height + dy * 0.008));
    look();
  }
  function move(dx, dy) {
    const side = new THREE.Vector3().setFromMatrixColumn(camera.matrix, 0);
    const up = new THREE.Vector3().setFromMatrixColumn(camera.matrix, 1);
    target.addScaledVector(side, (-dx * distance) / 700).addScaledVector(up, (dy * distance) / 700);
    look();
  }
  function zoom(factor) {
    view.distance = Math.min(60, Math.max(0.4, distance * factor));
    look();
  }
  const canvas = renderer.domElement;
  canvas.tabIndex = 0;
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", "The cell in three dimensions. Arrow keys turn the view, plus and minus zoom, 0 resets it.");
  canvas.style.touchAction = "none";
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, event);
    spread = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const [dx, dy] = [event.clientX - last.clientX, event.clientY - last.clientY];
    fingers.set(event.pointerId, event);
    if (fingers.size === 2) {
      const [one, other] = [...fingers.values()], now = Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      if (spread) zoom(spread / now);
      spread = now;
      move(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons === 4) move(dx, dy);
    else rotate(dx, dy);
  });
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return; // before a click on the cell the wheel moves the page
    event.preventDefault();
    zoom(Math.exp(event.deltaY * 0.001));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const turns = { ArrowLeft: [-20, 0], ArrowRight: [20, 0], ArrowUp: [0, 20], ArrowDown: [0, -20] }[event.key];
    if (turns) rotate(...turns);
    else if (event.key === "+" || event.key === "=") zoom(0.9);
    else if (event.key === "-") zoom(1.1);
    else if (event.key === "0") { view = { ...start }; look(); }
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
  new ResizeObserver(() => {
    const [width, height] = [place.clientWidth || 300, (place.clientHeight || 300) - SCALE_PX];
    renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    renderer.setSize(width, height);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    look();
  }).observe(place);
  dark.addEventListener("change", ground);
  ground();
  look();
  for (let arm = 0; arm < arms; arm++) {
    setMode(arm, 0);
    setHeat(arm, new Float32Array(turning).fill(marks[0]));
    setPose(arm, new Float32Array(turning), 0);
  }

  // Draw, if anything has changed.
  function draw() {
    if (changed) renderer.render(scene, camera);
    changed = false;
  }
  // Look at an arm; at the whole cell for -1.
  function focus(arm) {
    target.copy(arm < 0 ? centre : new THREE.Vector3(0, 0, STANDING_M / 2).applyMatrix4(mounts[arm]));
    view.distance = arm < 0 ? start.distance : 2.6;
    look();
  }
  return { setPose, setHeat, setMode, focus, draw, heatColour };
}
