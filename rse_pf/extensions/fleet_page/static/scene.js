// Draw a map with three.js: the point cloud, trajectories, and robots with the covariance of their alignment.  The
// camera is controlled by pointer and keys.

import { Cloud } from "./cloud.js";
import {
  Box3, BufferGeometry, Color, ColorManagement, GridHelper, Group, Line, LineBasicMaterial, LinearSRGBColorSpace, Mesh, MeshBasicMaterial,
  PerspectiveCamera, Points, PointsMaterial, Scene, SphereGeometry, Spherical, Vector3, WebGLRenderer,
} from "./vendor/three.module.js";

// Colours of robots, distinct for colour-blind people as well (Okabe and Ito 2008); names are drawn in any case.
const COLOURS = ["#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00"];
const MAX_FPS = 30; // largest number of frames per second
const FEWEST_POINTS = 50_000; // smallest number of points of a frame while the view changes
const FILLING_POINTS = 200_000; // smallest number of points that a frame adds while the view does not change
const SLOW_MS = 70; // after a longer time between frames, the next frame draws fewer points
const FAST_MS = 40; // after a shorter time between frames, the next frame draws more points
const CLOUD_LAYER = 1; // three.js layer of the cloud: alone, it is drawn over the previous frame
const HOME = [0.95, 0.6]; // spherical angles of the first view, in radians: from the vertical, and around it
const MARGIN = 0.88; // part of the canvas that the map fills in the first view, so that names of robots fit
ColorManagement.enabled = false; // there is no lighting: the colours of the camera images are shown unchanged

export class MapScene {
  constructor(canvas, labels) {
    this.canvas = canvas;
    this.labels = labels;
    this.renderer = new WebGLRenderer({ canvas, context: contextOf(canvas) });
    this.renderer.outputColorSpace = LinearSRGBColorSpace;
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(55, 1, 0.02, 2000);
    this.world = new Group();
    this.scene.add(this.world);
    this.moving = new Group();
    this.world.add(this.moving);
    this.places = new Map();
    this.target = new Vector3();
    this.orbit = new Spherical(8, 1.0, 0.6);
    this.radius = 4;
    this.cloudReach = [];
    this.robotReach = [];
    this.dirty = true;
    this.frames = 0;
    this.shown = null;
    this.waiting = [];
    this.budget = FEWEST_POINTS;
    this.isFilling = false; // whether the newest frame added points to the previous one
    this.count = 0; // number of points of the cloud that are on the canvas
    this.listen();
    this.themed();
    new ResizeObserver(() => { this.dirty = true; }).observe(canvas);
  }

  // Let the graphics driver compile the shaders for a cloud now, which takes longer than drawing it.
  warmUp() {
    const cloud = new Cloud({ points: 1, step: [1, 1, 1], low: [0, 0, 0] });
    cloud.take(new Uint8Array(9), 1);
    cloud.show(0, 1);
    this.world.add(cloud.points);
    this.renderer.setSize(16, 16, false);
    this.renderer.render(this.scene, this.camera);
    this.world.remove(cloud.points);
    cloud.dispose();
  }

  themed() {
    // Not scene.background, which would be drawn over the points of the previous frame.
    this.renderer.setClearColor(new Color(getComputedStyle(document.documentElement).getPropertyValue("--panel").trim()), 1);
    this.dirty = true;
  }

  clear() {
    this.world.clear();
    this.moving = new Group();
    this.world.add(this.moving);
    this.places.clear();
    this.labels.replaceChildren();
    this.hasCloud = this.touched = false;
    [this.cloudReach, this.robotReach] = [[], []];
    this.dropCloud();
    this.dirty = true;
  }

  // Show the cloud with the header *header*, whose points are added by more(); *withPaths* also draws its trajectories.
  begin(header, withPaths) {
    this.dropCloud();
    this.shown = new Cloud(header);
    this.shown.points.layers.enable(CLOUD_LAYER);
    this.world.add(this.shown.points);
    this.turnUp(new Vector3(...header.up));
    if (withPaths) Object.entries(header.robots).forEach(([name, path]) => this.path(this.world, name, path));
    this.cloudReach = cornersOf(header.fit);
    if (withPaths) this.cloudReach.push(...Object.values(header.robots).flat().map((each) => new Vector3(...each)));
    this.hasCloud = header.points > 0;
    this.fit(this.robotReach);
    if (!this.touched) this.home();
  }

  // Compute centre and radius of the points that the first view must show: the cloud and *robotReach*, the positions
  // of robots and their paths.
  fit(robotReach) {
    this.robotReach = robotReach;
    const all = [...this.cloudReach, ...robotReach].map((each) => each.clone().applyMatrix4(this.world.matrix));
    if (!all.length) return;
    const box = new Box3().setFromPoints(all);
    this.centre = box.getCenter(new Vector3());
    this.seen = all.map((each) => each.sub(this.centre));
    this.radius = Math.max(box.getSize(new Vector3()).length() / 2, 0.5);
  }

  // Return the distance in metres from which the first view shows all points of fit().
  distance() {
    const back = new Vector3().setFromSpherical(new Spherical(1, ...HOME));
    const right = new Vector3(0, 1, 0).cross(back).normalize();
    const up = back.clone().cross(right);
    const high = Math.tan((this.camera.fov * Math.PI) / 360) * MARGIN;
    const aspect = (this.canvas.clientWidth || 1) / (this.canvas.clientHeight || 1);
    const needed = (this.seen ?? []).map((each) => each.dot(back) + Math.max(Math.abs(each.dot(right)) / (high * aspect), Math.abs(each.dot(up)) / high));
    return Math.max(0.8, ...needed);
  }

  more(bytes, count) {
    this.shown.take(bytes, count);
  }

  dropCloud() {
    this.shown?.dispose();
    this.shown = null;
  }

  // Return a promise that resolves when *count* points of the cloud are on the canvas, or the cloud is not shown any more.
  drawn(count) {
    const cloud = this.shown;
    return new Promise((resolve) => { this.waiting.push({ cloud, count, resolve }); });
  }

  // Rotate the world so that the direction *up* of the map points upward on the screen.
  turnUp(up) {
    this.world.quaternion.setFromUnitVectors(up.lengthSq() > 1e-9 ? up.normalize() : new Vector3(0, -1, 0), new Vector3(0, 1, 0));
    this.world.updateMatrix();
  }

  // Return the colour of the robot *name*, which is assigned at the first call.
  colour(name) {
    if (!this.places.has(name)) this.places.set(name, { colour: COLOURS[this.places.size % COLOURS.length], label: null, at: null });
    return this.places.get(name).colour;
  }

  path(parent, name, points) {
    const geometry = new BufferGeometry().setFromPoints(points.map((each) => new Vector3(...each)));
    const line = new Line(geometry, new LineBasicMaterial({ color: this.colour(name) }));
    parent.add(line);
    this.place(name, points.length ? new Vector3(...points[points.length - 1]) : null);
    return line;
  }

  // Put the label of the robot *name* at the position *at*; null hides it.
  place(name, at) {
    const known = this.places.get(name);
    known.at = at;
    if (!known.label) {
      known.label = document.createElement("span");
      known.label.textContent = name;
      known.label.style.borderLeft = `4px solid ${known.colour}`;
      this.labels.append(known.label);
    }
  }

  // Draw the robots of a live map again; *state* maps the keys of its topic to their values.
  update(state) {
    this.moving.traverse((each) => { each.geometry?.dispose(); each.material?.dispose(); });
    this.moving.clear();
    const reach = [];
    for (const [, value] of state) {
      if (value.kind !== "history") continue;
      const parts = value.parts.filter((each) => each.length).map((part) => part.map((each) => new Vector3(...each)));
      this.colour(value.robot);
      for (const points of parts) this.moving.add(...this.drive(points, this.colour(value.robot)));
      if (parts.length) this.place(value.robot, parts[parts.length - 1].at(-1));
      reach.push(...parts.flat());
    }
    for (const [, value] of state) {
      if (value.kind !== "alignment" || !value.aligned || !value.T_map_odom) continue;
      const pose = state.get(`pose/${value.robot}`);
      if (!pose) continue;
      const at = new Vector3(pose.T_map_camera[3], pose.T_map_camera[7], pose.T_map_camera[11]);
      this.colour(value.robot);
      this.place(value.robot, at);
      this.moving.add(this.robot(at, this.colour(value.robot), value.covariance));
      reach.push(at);
    }
    if (reach.length) {
      if (!this.hasCloud && !this.isTurned) { this.turnUp(new Vector3(0, -1, 0)); this.isTurned = true; }
      this.fit(reach);
      if (!this.hasCloud) this.moving.add(this.grid(this.centre.clone().applyMatrix4(this.world.matrix.clone().invert()), reach));
      if (!this.touched) this.home();
    }
    this.dirty = true;
  }

  // Return the objects of a path: a line, and a dot for each pose, since lines of WebGL are only one pixel wide.
  drive(points, color) {
    const geometry = new BufferGeometry().setFromPoints(points);
    return [new Line(geometry, new LineBasicMaterial({ color })), new Points(geometry, new PointsMaterial({ color, size: 5, sizeAttenuation: false }))];
  }

  // Return a grid with squares of 1 m below the robots, which shows the scale while there is no cloud.
  grid(centre, reach) {
    const metres = 2 * Math.ceil(this.radius + 1);
    const line = getComputedStyle(document.documentElement).getPropertyValue("--line").trim();
    const grid = new GridHelper(metres, metres, line, line);
    grid.position.set(Math.round(centre.x), Math.max(...reach.map((each) => each.y)) + 0.3, Math.round(centre.z));
    return grid;
  }

  // Return a robot: a sphere with a radius of 4 cm, and around it an ellipsoid of three standard deviations of the
  // position along the map's axes (half axes of 4.5 cm to 3 m).
  robot(at, colour, covariance) {
    const group = new Group();
    group.position.copy(at);
    group.add(new Mesh(new SphereGeometry(0.04, 12, 8), new MeshBasicMaterial({ color: colour })));
    if (covariance) {
      const sigma = [covariance[0], covariance[6], covariance[11]].map((each) => 3 * Math.sqrt(Math.max(each, 0)));
      const around = new Mesh(new SphereGeometry(1, 20, 14), new MeshBasicMaterial({ color: colour, transparent: true, opacity: 0.22, depthWrite: false }));
      around.scale.set(...sigma.map((each) => Math.min(Math.max(each, 0.045), 3)));
      group.add(around);
    }
    return group;
  }

  // Return to the first view, which shows the whole map.
  home() {
    this.target.copy(this.centre ?? new Vector3());
    this.orbit.set(this.distance(), ...HOME);
    this.touched = false;
    this.dirty = true;
  }

  listen() {
    const turn = (dx, dy) => {
      this.orbit.theta -= dx;
      this.orbit.phi = Math.min(Math.max(this.orbit.phi - dy, 0.05), Math.PI - 0.05);
      this.dirty = this.touched = true;
    };
    const zoom = (factor) => { this.orbit.radius = Math.min(Math.max(this.orbit.radius * factor, 0.1), 1000); this.dirty = this.touched = true; };
    const shift = (dx, dy) => {
      const right = new Vector3().setFromMatrixColumn(this.camera.matrix, 0);
      const up = new Vector3().setFromMatrixColumn(this.camera.matrix, 1);
      this.target.addScaledVector(right, -dx * this.orbit.radius).addScaledVector(up, dy * this.orbit.radius);
      this.dirty = this.touched = true;
    };
    const pointers = new Map();
    this.canvas.addEventListener("pointerdown", (event) => { pointers.set(event.pointerId, event); this.canvas.setPointerCapture(event.pointerId); });
    for (const name of ["pointerup", "pointercancel"]) this.canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
    this.canvas.addEventListener("pointermove", (event) => {
      const last = pointers.get(event.pointerId);
      if (!last) return;
      const [dx, dy] = [(event.clientX - last.clientX) / this.canvas.clientHeight, (event.clientY - last.clientY) / this.canvas.clientHeight];
      if (pointers.size === 2) {
        const other = [...pointers.values()].find((each) => each.pointerId !== event.pointerId);
        const apart = (each) => Math.hypot(each.clientX - other.clientX, each.clientY - other.clientY) || 1;
        zoom(apart(last) / apart(event));
      } else if (event.shiftKey || event.buttons === 4) shift(dx, dy);
      else turn(dx * 4, dy * 4);
      pointers.set(event.pointerId, event);
    });
    this.canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(event.deltaY / 700)); }, { passive: false });
    this.canvas.addEventListener("keydown", (event) => {
      const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };
      if (turns[event.key]) turn(...turns[event.key]);
      else if (event.key === "+" || event.key === "=") zoom(0.85);
      else if (event.key === "-") zoom(1.18);
      else if (event.key === "Home") this.home();
      else return;
      event.preventDefault();
    });
  }

  // Start or stop drawing.
  run(on) {
    this.running = on;
    if (on && !this.looping) { this.looping = true; this.dirty = true; this.loop(0); }
  }

  loop(now) {
    if (!this.running) { this.looping = false; return; }
    requestAnimationFrame((time) => this.loop(time));
    const since = now - (this.drawnAt ?? 0);
    const isWhole = this.count >= (this.shown?.ready ?? 0);
    if ((!this.dirty && isWhole) || since < 1000 / MAX_FPS) return;
    // The time between successive frames is a measure of the time that a frame takes.
    if (since < FAST_MS) this.budget = Math.min(this.budget * 1.2, 1e9);
    else if (since > SLOW_MS && since < 1000 && !this.isFilling) this.budget = Math.max(FEWEST_POINTS, this.budget * 0.7);
    this.drawnAt = now;
    this.draw();
  }

  // Draw a new frame if something changed; otherwise add the next points of the cloud to the previous frame.
  draw() {
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    if (!width || !height) return;
    const ratio = Math.min(devicePixelRatio || 1, 2);
    if (this.canvas.width !== Math.floor(width * ratio) || this.canvas.height !== Math.floor(height * ratio)) {
      this.renderer.setPixelRatio(ratio);
      this.renderer.setSize(width, height, false);
      this.dirty = true;
    }
    if (this.dirty) this.count = 0;
    this.renderer.autoClear = this.dirty;
    this.camera.layers.set(this.dirty ? 0 : CLOUD_LAYER);
    this.isFilling = !this.dirty;
    this.dirty = false;
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.camera.position.setFromSpherical(this.orbit).add(this.target);
    this.camera.lookAt(this.target);
    this.camera.updateMatrixWorld();
    this.count += this.shown?.show(this.count, this.isFilling ? Math.max(this.budget, FILLING_POINTS) : this.budget) ?? 0;
    this.renderer.render(this.scene, this.camera);
    this.frames += 1;
    this.resolveWaiting();
    for (const [, { label, at }] of this.places) {
      if (!label) continue;
      const seen = at?.clone().applyMatrix4(this.world.matrix).project(this.camera);
      label.hidden = !seen || seen.z > 1;
      if (seen) { label.style.left = `${(seen.x + 1) / 2 * width + 8}px`; label.style.top = `${(1 - seen.y) / 2 * height - 20}px`; }
    }
  }

  // Resolve the promises of drawn() whose number of points is on the canvas.
  resolveWaiting() {
    const done = this.waiting.filter((each) => each.cloud !== this.shown || this.count >= each.count);
    if (!done.length) return;
    const gl = this.renderer.getContext();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); // waits until the frame is drawn
    this.waiting = this.waiting.filter((each) => !done.includes(each));
    for (const each of done) each.resolve();
  }
}

// Return a WebGL 2 context, with antialiasing only on a graphics card: software rendering would take four times as long.
function contextOf(canvas) {
  const wanted = { alpha: true, depth: true, stencil: false, powerPreference: "low-power", preserveDrawingBuffer: true };
  return canvas.getContext("webgl2", { ...wanted, antialias: true, failIfMajorPerformanceCaveat: true })
    ?? canvas.getContext("webgl2", { ...wanted, antialias: false });
}

// Return the eight corners of the box with the corners *fit* (lowest, highest); none without a box.
function cornersOf(fit) {
  if (!fit?.length) return [];
  const [low, high] = fit;
  return [0, 1, 2, 3, 4, 5, 6, 7].map((bits) => new Vector3(...[0, 1, 2].map((axis) => (bits >> axis & 1 ? high : low)[axis])));
}
