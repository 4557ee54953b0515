// The viewer: Gaussians in a canvas, by WebGL2, or on the processor where the browser has no graphics card.
//
// The files of this folder are classic scripts without imports, because a page opened from file:// may load no module.
// They share one scope. tools/web/build.sh joins them for the page (index.html), `subsplat` for every exported scene
// (scene.html), in the order of their names: constants of arithmetic.js precede their first use.
//
// Projection, low-pass and blending are the crate's `standard` convention (kernels/src/cpu/raster/ewa.rs,
// kernels/src/layout/mod.rs); the movements are those of src/scene/navigation.rs.
"use strict";

const KEYS = [
  ["Drag, or arrow keys", "rotate"],
  ["Right or Shift drag, two fingers, or Shift arrows", "shift"],
  ["Wheel, pinch, + and −", "nearer and farther; when flying: faster and slower"],
  ["W A S D, E Q", "move forward, left, back, right, up, down"],
  ["F", "fly: leave the range of good views; or orbit within it"],
  ["V", "next photograph’s place"],
  ["R", "back to the start"],
  ["L", "all Gaussians, or fewer where they are far"],
  ["P", "save the picture as you see it, at twice the size"],
  ["Escape", "close this list"],
];

/** Excess of the range of views from which on a movement out of it slows down. */
const SOFT = 0.6;
/** Part of the reach that a drag of 100 px turns by. */
const DRAG_REACH = 0.8;
/** Time of a picture above which it is drawn smaller on the processor while the view moves, ms. */
const SLOW = 100;
/** Time of a picture up to which a view swings unasked, ms: a processor that draws has time for other work. */
const QUICK = 40;
/** Largest part of the background's colour in views outside the range. */
const FADE_MAX = 0.7;
/** Most pixels of a saved picture. */
const PICTURE_MAX = 24e6;

/** A viewer inside the element `root`. */
class SplatViewer {
  /**
   * `draw`: "auto", "webgl" or "cpu"; `levels`: whether far parts are drawn with fewer Gaussians; `range`: whether
   * views stay where the photographs support them; `swing`: whether the view moves until somebody touches it, "auto"
   * (where pictures are quick), "on" or "off".
   */
  constructor(root, { draw = "auto", levels = true, range = true, swing = "auto" } = {}) {
    this.root = root;
    this.useLevels = levels;
    this.useRange = range;
    this.swings = swing;
    root.classList.add("splat-viewer");
    root.innerHTML = `
      <canvas tabindex="0" role="application" aria-roledescription="3D view"
        aria-label="3D scene. Arrow keys rotate, plus and minus change the distance, W A S D move."></canvas>
      <div class="splat-tools" role="toolbar" aria-label="View">
        <button type="button" data-do="fly" aria-pressed="false">Fly</button>
        <button type="button" data-do="nearer" aria-label="Nearer">+</button>
        <button type="button" data-do="farther" aria-label="Farther">−</button>
        <button type="button" data-do="view">Next view</button>
        <button type="button" data-do="reset">Reset</button>
        <button type="button" data-do="picture">Save picture</button>
        <button type="button" data-do="share" hidden>Share</button>
        <button type="button" data-do="help" aria-expanded="false">Keys</button>
      </div>
      <dl class="splat-keys" hidden></dl>
      <p class="splat-status" role="status" aria-live="polite"></p>`;
    this.canvas = root.querySelector("canvas");
    this.status = root.querySelector(".splat-status");
    this.keys = root.querySelector(".splat-keys");
    for (const [key, meaning] of KEYS) {
      const term = document.createElement("dt"), text = document.createElement("dd");
      [term.textContent, text.textContent] = [key, meaning];
      this.keys.append(term, text);
    }
    this.painter = null;
    if (draw !== "cpu") {
      try {
        this.painter = new GlPainter(this.canvas, draw === "auto");
      } catch (error) {
        if (draw === "webgl") throw error;
        // A canvas keeps its first context.
        const fresh = this.canvas.cloneNode(true);
        this.canvas.replaceWith(fresh);
        this.canvas = fresh;
      }
    }
    this.painter ??= new CpuPainter(this.canvas);
    this.button("share").hidden = !canShare(new File([], "view.png", { type: "image/png" }));
    this.held = new Set();
    this.pointers = new Map();
    /** Size of a picture while the view moves, of its full size. */
    this.draft = this.painter instanceof GlPainter ? 1 : 0.25;
    this.listen();
  }

  say(text) {
    this.status.textContent = text;
  }

  button(name) {
    return this.root.querySelector(`[data-do=${name}]`);
  }

  /**
   * Shows a scene. `spz`: the file's bytes; `settings`: `cameras` (of cameras.json, one object each, with a `name`
   * where there is one), `photographs` (false where the cameras are of other views), `background`, `near`, `lowpass`.
   * `keep`: the scene is a later state of the one before, and the view stays; `final`: no later state follows.
   */
  async load(spz, settings = {}, { keep = false, final = true } = {}) {
    const scene = await parseSpz(spz);
    if (scene.count === 0) throw new Error("The scene holds no Gaussian.");
    this.painter.load(scene);
    this.scene = scene;
    this.background = settings.background ?? [0, 0, 0];
    this.rules = { near: settings.near ?? 0.01, lowpass: settings.lowpass ?? 0.3 };
    const box = bounds(scene);
    const cameras = (settings.cameras ?? []).map(toViewer);
    this.cameras = cameras.length ? cameras : [wholeCamera(box)];
    this.place = settings.photographs === false ? "View" : "Photograph";
    this.button("view").textContent = `Next ${settings.photographs === false ? "view" : "photo"}`;
    const up = cameras.reduce((sum, c) => add(sum, column(c.rotation, 1), -1), [0, 0, 0]);
    this.up = unit(up) ?? [0, 1, 0];
    this.radius = Math.max(0.5 * Math.hypot(...add(box[1], box[0], -1)), 1e-3);
    this.button("view").hidden = this.cameras.length < 2;
    this.levels = null;
    this.cost = null;
    this.range = this.useRange ? ViewRange.of(scene, cameras) : null;
    this.drawn = scene.count;
    if (keep) {
      this.redraw();
    } else {
      this.view = 0;
      this.fly = false;
      this.button("fly").setAttribute("aria-pressed", "false");
      this.swinging = null;
      this.touched = false;
      this.reset();
    }
    this.sayCount();
    // The range is measured and the levels are made after the first picture.
    if (final) setTimeout(() => this.prepare(scene).catch(() => { this.levels = null; }), 100);
  }

  /** Measures the range of views, begins the swing and makes the levels, until another scene is loaded. */
  async prepare(scene) {
    const pause = slices(() => this.scene === scene);
    if (this.range && await this.range.measure(pause)) {
      // The time of a picture at its full size decides on the swing.
      if (this.cost === null) this.rest();
      this.swing();
    }
    await this.makeLevels(scene);
  }

  /** Moves the view gently about where it is, until somebody touches it: only where pictures are quick, or if asked. */
  swing() {
    const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    const asked = this.swings === "on";
    if (this.touched || this.swings === "off" || still || !asked && this.cost > QUICK) return;
    this.runSwing(new Swing(this), asked);
  }

  async runSwing(swing, patient) {
    this.swinging = swing;
    this.atRest = false;
    await swing.run(() => this.swinging === swing, patient);
    if (this.swinging !== swing) return;
    this.swinging = null;
    this.redraw();
  }

  /** Ends the swing where it is. */
  touch() {
    this.touched = true;
    if (!this.swinging) return;
    this.swinging = null;
    this.redraw();
  }

  /** Says the number of Gaussians drawn. */
  sayCount() {
    const [drawn, all] = [this.drawn, this.scene.count].map((n) => n.toLocaleString("en"));
    this.countText = `${drawn === all ? all : `${drawn} of ${all}`} Gaussians, drawn by ${this.painter.name}`;
    this.say(this.countText);
  }

  /** Makes the levels of a scene in the background, until another one is loaded. */
  async makeLevels(scene) {
    const pause = slices(() => this.scene === scene);
    const levels = await Levels.make(scene, pause);
    if (!levels || !await this.painter.extend(levels.scene, pause)) return;
    this.levels = levels;
  }

  /** Says which photograph's place the view has. */
  sayPlace() {
    const name = this.home.name ? `: ${this.home.name}` : "";
    this.say(`${this.place} ${this.view + 1} of ${this.cameras.length}${name}`);
  }

  /** Goes to the place of a photograph. */
  reset(view = this.view) {
    this.view = view;
    const home = this.cameras[view];
    this.home = home;
    this.rotation = [...home.rotation];
    this.eye = [...home.eye];
    const z = depths(this.scene, home);
    this.distance = z.length ? z[z.length >> 1] : this.radius;
    this.speed = 0.4 * this.radius;
    this.redraw();
  }

  forward() {
    return column(this.rotation, 2);
  }

  pivot() {
    return add(this.eye, this.forward(), this.distance);
  }

  /** Does a movement in parts; each of them is shorter where it leads out of the range of views. */
  within(parts, move) {
    const count = Math.min(Math.max(1, Math.ceil(parts)), 64), { range } = this;
    for (let k = 0; k < count; k++) {
      const { eye, rotation, distance } = this;
      const before = range && !this.fly ? range.excess(eye, this.forward()) : 0;
      move(1 / count);
      if (!range || this.fly) continue;
      const after = range.excess(this.eye, this.forward());
      if (after <= before || after <= SOFT) continue;
      Object.assign(this, { eye, rotation, distance });
      const share = Math.min((1 - before) / (1 - SOFT), 1);
      if (share > 0) move(share / count);
    }
    this.redraw();
  }

  /** Rotates by a drag, px of a picture `height` px high. */
  rotate(x, y, height = this.canvas.clientHeight) {
    let scale = Math.PI / height;
    if (this.range && !this.fly) scale = Math.min(scale, DRAG_REACH / 100 * this.range.reach(this.eye));
    this.within(Math.abs(x) / 16, (part) => this.turn(-scale * x * part, 0));
    this.within(Math.abs(y) / 16, (part) => this.turn(0, -scale * y * part));
  }

  /** Turns about the world's up and raises the view, radians; about the eye when flying. */
  turn(side, rise) {
    const pivot = this.pivot();
    const elevation = Math.asin(Math.min(Math.max(dot(this.forward(), this.up), -1), 1));
    const limit = Math.max(89 * Math.PI / 180, Math.abs(elevation));
    const raised = Math.min(Math.max(elevation + rise, -limit), limit) - elevation;
    const turned = multiply(about(this.up, side), this.rotation);
    this.rotation = orthonormal(multiply(turned, about([1, 0, 0], raised)));
    if (!this.fly) this.eye = add(pivot, this.forward(), -this.distance);
  }

  pan(x, y) {
    const k = fitted(this.home, this.canvas.clientWidth, this.canvas.clientHeight);
    for (const along of [[x / k.fx, 0, 0], [0, y / k.fy, 0]]) {
      const shift = apply(this.rotation, along);
      this.within(Math.hypot(...along) / 0.02, (part) => { this.eye = add(this.eye, shift, -this.distance * part); });
    }
  }

  /** Steps of the wheel, positive nearer or faster. */
  wheel(steps) {
    const within = (v) => Math.min(Math.max(v, 1e-3 * this.radius), 1e3 * this.radius);
    if (this.fly) {
      this.speed = within(this.speed * 1.25 ** steps);
      return;
    }
    this.within(2 * Math.abs(steps), (part) => {
      const pivot = this.pivot();
      this.distance = within(this.distance * 0.9 ** (steps * part));
      this.eye = add(pivot, this.forward(), -this.distance);
    });
  }

  move([right, up, forward], seconds) {
    const ways = [[right, 0, 0], [0, 0, forward]].map((way) => apply(this.rotation, way));
    ways.push(this.up.map((v) => up * v));
    const length = Math.max(1, Math.hypot(...ways.reduce((sum, way) => add(sum, way))));
    const far = this.speed * seconds / length;
    for (const way of ways) {
      const parts = far * Math.hypot(...way) / (0.02 * this.distance);
      if (parts > 0) this.within(parts, (part) => { this.eye = add(this.eye, way, far * part); });
    }
  }

  redraw() {
    if (this.pending || !this.scene) return;
    this.pending = true;
    this.atRest = false;
    requestAnimationFrame(() => {
      this.pending = false;
      this.paint(this.draft);
      // The full size, at rest. The number is said at rest too, and replaces no other message.
      clearTimeout(this.counting);
      this.counting = setTimeout(() => this.rest(), 300);
    });
  }

  /** Draws the picture of a view that rests. */
  rest() {
    clearTimeout(this.counting);
    if (this.draft < 1) this.paint();
    this.atRest = true;
    if (this.status.textContent === this.countText) this.sayCount();
  }

  /** Draws the view; `part` of its size makes a picture quicker. */
  paint(part = 1) {
    const hardware = this.painter instanceof GlPainter;
    const ratio = part * (hardware ? Math.min(window.devicePixelRatio || 1, 2) : 1);
    const width = Math.max(1, Math.round(ratio * this.canvas.clientWidth));
    const height = Math.max(1, Math.round(ratio * this.canvas.clientHeight));
    const begin = performance.now();
    this.paintAt(fitted(this.home, width, height));
    const spent = performance.now() - begin;
    if (part === 1) this.cost = spent;
    if (!hardware && part === this.draft) {
      this.draft = Math.min(Math.max(part * Math.sqrt(SLOW / spent), 0.15), 1);
    }
  }

  /** Draws the view at a size, px; it fades outside the range of views. */
  paintAt(intrinsics) {
    const { width, height } = intrinsics;
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
    const camera = { ...intrinsics, rotation: this.rotation, eye: this.eye };
    const view = projection(camera, this.rules);
    const chosen = this.useLevels && this.levels ? this.levels.select(view) : null;
    const excess = this.range ? this.range.excess(this.eye, this.forward()) : 0;
    this.painter.draw(view, this.background, chosen, FADE_MAX * Math.min(Math.max((excess - 1) / 2, 0), 1));
    this.drawn = chosen ? chosen.length : this.scene.count;
  }

  /** The current view at the size of the photographs, as ImageData. */
  capture() {
    const { width, height } = this.home;
    this.paintAt(fitted(this.home, width, height));
    const data = new ImageData(new Uint8ClampedArray(this.painter.pixels(width, height)), width);
    this.redraw();
    return data;
  }

  /** The view as the screen frames it at `times` its size, as a PNG. */
  picture(times = 2) {
    const { clientWidth, clientHeight } = this.canvas;
    let ratio = times * Math.min(window.devicePixelRatio || 1, 2);
    ratio = Math.min(ratio, Math.sqrt(PICTURE_MAX / (clientWidth * clientHeight)),
      this.painter.sideMax / Math.max(clientWidth, clientHeight));
    const [width, height] = [clientWidth, clientHeight].map((side) => Math.floor(ratio * side));
    this.paintAt(fitted(this.home, width, height));
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [width, height];
    canvas.getContext("2d").putImageData(
      new ImageData(new Uint8ClampedArray(this.painter.pixels(width, height)), width), 0, 0);
    this.redraw();
    return new Promise((done) => canvas.toBlob(done, "image/png"));
  }

  async savePicture() {
    saveBlob(await this.picture(), "view.png");
  }

  /** Whether the viewer can record a clip. */
  canClip() {
    return Boolean(this.range && clipKind(this.canvas));
  }

  /** Records one swing about the view as it is, in the time that it takes. */
  async clip() {
    this.touch();
    this.say(`Recording ${CLIP_SECONDS} seconds …`);
    const swing = new Swing(this, { seconds: CLIP_SECONDS, swings: 1, grows: 0 });
    const clip = await record(this.canvas, () => this.runSwing(swing, true));
    this.sayCount();
    return clip;
  }

  async share() {
    const file = new File([await this.picture()], "view.png", { type: "image/png" });
    // Whoever closes the list of receivers shares nothing.
    await navigator.share({ files: [file], title: document.title }).catch(() => {});
  }

  act(name) {
    if (!this.scene) return;
    this.touch();
    const button = this.button(name);
    switch (name) {
      case "fly":
        this.fly = !this.fly;
        button.setAttribute("aria-pressed", String(this.fly));
        this.say(this.fly ? "Flying: drags turn the view, and it may leave the range of good views."
          : "Orbiting: drags turn the scene.");
        break;
      case "nearer": this.fly ? this.move([0, 0, 1], 0.25) : this.wheel(1); break;
      case "farther": this.fly ? this.move([0, 0, -1], 0.25) : this.wheel(-1); break;
      case "view":
        this.reset((this.view + 1) % this.cameras.length);
        this.sayPlace();
        break;
      case "reset": this.reset(); break;
      case "levels":
        this.useLevels = !this.useLevels;
        this.paint();
        this.sayCount();
        break;
      case "picture": this.savePicture(); break;
      case "share": this.share(); break;
      case "help": this.showKeys(this.keys.hidden); break;
    }
  }

  showKeys(open) {
    this.keys.hidden = !open;
    this.button("help").setAttribute("aria-expanded", String(open));
  }

  listen() {
    const { canvas, pointers } = this;
    this.root.addEventListener("keydown", (event) => {
      if (event.key !== "Escape" || this.keys.hidden) return;
      this.showKeys(false);
      event.preventDefault();
    });
    this.root.querySelector(".splat-tools").addEventListener("click", (event) => {
      const button = event.target.closest("button");
      if (button) this.act(button.dataset.do);
    });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      this.touch();
      canvas.setPointerCapture(event.pointerId);
      canvas.focus({ preventScroll: true, focusVisible: false });
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    const release = (event) => pointers.delete(event.pointerId);
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before || !this.scene) return;
      const now = [event.clientX, event.clientY];
      const [x, y] = [now[0] - before[0], now[1] - before[1]];
      if (pointers.size === 2) {
        const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
        const gap = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
        this.wheel(Math.log(gap(before) / Math.max(gap(now), 1)) / Math.log(0.9));
        this.pan(0.5 * x, 0.5 * y);
      } else if (event.shiftKey || event.buttons & 6) {
        this.pan(x, y);
      } else {
        this.rotate(x, y);
      }
      pointers.set(event.pointerId, now);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.touch();
      if (this.scene) this.wheel(-event.deltaY / (event.deltaMode === 0 ? 100 : 3));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => this.keyDown(event));
    canvas.addEventListener("keyup", (event) => this.held.delete(event.code));
    canvas.addEventListener("blur", () => this.held.clear());
    new ResizeObserver(() => this.redraw()).observe(canvas);
  }

  keyDown(event) {
    this.touch();
    if (!this.scene || event.ctrlKey || event.altKey || event.metaKey) return;
    const step = 24;
    const arrows = {
      ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step],
    };
    const actions = {
      KeyF: "fly", KeyV: "view", KeyR: "reset", Home: "reset", KeyP: "picture", KeyL: "levels", KeyH: "help",
    };
    if (arrows[event.code]) {
      event.shiftKey ? this.pan(...arrows[event.code]) : this.rotate(...arrows[event.code], 512);
    } else if (event.key === "+" || event.key === "=") {
      this.wheel(1);
    } else if (event.key === "-") {
      this.wheel(-1);
    } else if (actions[event.code]) {
      if (!event.repeat) this.act(actions[event.code]);
    } else if (/^Key[WASDEQ]$/.test(event.code)) {
      this.held.add(event.code);
      this.walk();
    } else {
      return;
    }
    event.preventDefault();
  }

  /** Moves while keys are held. */
  walk() {
    if (this.walking) return;
    this.walking = true;
    let before = performance.now();
    const frame = (now) => {
      const key = (code) => Number(this.held.has(code));
      const along = [
        key("KeyD") - key("KeyA"), key("KeyE") - key("KeyQ"), key("KeyW") - key("KeyS"),
      ];
      this.walking = this.held.size > 0;
      if (!this.walking) return;
      this.move(along, Math.min(Math.max((now - before) / 1000, 0), 0.1));
      before = now;
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }
}

/** Whether the browser shares such a file with other programs. */
function canShare(file) {
  return Boolean(navigator.canShare?.({ files: [file] }));
}

/** Offers a blob as a download. */
function saveBlob(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}
