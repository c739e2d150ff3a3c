// The page: what is shown, from where and when, and how people change it.

const REST = 180; // milliseconds without a change after which a picture is drawn at full sharpness
const SCALES = [1, 0.75, 0.55, 0.4, 0.3]; // of the canvas's pixels, while something moves
const SLOW = 45, QUICK = 24; // milliseconds between frames from which on pictures become smaller, or larger
const QUIET = 2800; // milliseconds after which the controls fade while the scene plays
const STEADY = Math.cos(0.5), STEP = 0.5; // between cameras of a path: least cosine, most of the distance
const TRUST = 8, LEAST_TRUST = 2; // degrees beside a film's path: of files that do not say it; that are always let
const SPRING = 260, HOLD = 700; // milliseconds in which a lean goes back, mostly; after which one by keys does
const LEAN_CROP = 0.12; // by how much the frame narrows at the edge of what is trusted
const MOST_ZOOM = 4; // of a film's frame
const BEHIND = { dark: [0.055, 0.059, 0.071], light: [1, 1, 1] };

const byId = (id) => document.getElementById(id);
const clamp = (value, least, most) => Math.min(Math.max(value, least), most);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const add = (a, b, factor = 1) => a.map((value, i) => value + factor * b[i]);
const unit = (a) => a.map((value) => value / (Math.hypot(...a) || 1));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

// Turn a vector by an angle about a unit axis.
function turned(v, axis, angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)], along = (1 - c) * dot(axis, v), across = cross(axis, v);
  return v.map((value, i) => c * value + s * across[i] + along * axis[i]);
}

// Return the bytes of the scene in the page: base64 of raw deflate.
async function unpacked(text) {
  const packed = Uint8Array.from(atob(text.trim()), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Start the worker that sorts; where there is none, the page sorts itself. Browsers refuse a "blob:" worker to
// a page that was opened as a file, and take one from a "data:" address.
class Sorting {
  constructor(scene, done) {
    const { count, moving, places, links, weights } = scene;
    this.scene = { count, moving, places, links, weights };
    this.done = done;
    this.busy = this.next = null;
    this.milliseconds = 0;
    const code = `${byId("motion").textContent}\nsortInWorker();`;
    const place = location.protocol.startsWith("http")
      ? URL.createObjectURL(new Blob([code], { type: "text/javascript" }))
      : `data:text/javascript;charset=utf-8,${encodeURIComponent(code)}`;
    try {
      this.worker = new Worker(place);
      this.worker.onmessage = ({ data }) => this.take(data);
      this.worker.onerror = () => this.fallBack();
      this.worker.postMessage({ scene: this.scene });
    } catch {
      this.fallBack();
    }
  }

  fallBack() {
    this.worker = null;
    this.own = new Sorter(this.scene);
    if (this.busy) this.send(this.busy);
  }

  // Ask for the order of a state; of several asked for meanwhile the last counts.
  ask(maps, eye) {
    const asked = { maps: maps && maps.slice(), eye };
    if (this.busy) this.next = asked;
    else this.send(asked);
  }

  send(asked) {
    this.busy = asked;
    if (this.worker) this.worker.postMessage(asked);
    else setTimeout(() => this.take({ order: this.own.sorted(asked.maps, asked.eye), milliseconds: 0 }));
  }

  take({ order, milliseconds }) {
    const { next } = this;
    this.milliseconds = milliseconds;
    this.busy = this.next = null;
    if (next) this.send(next);
    this.done(order);
  }
}

// Return the cameras of the file by their times if one camera went smoothly from each to the next; else null.
function pathOf({ cameras, focus }) {
  const path = cameras.filter(({ time }) => time !== undefined).sort((a, b) => a.time - b.time);
  const near = (a, b) => {
    const away = Math.hypot(...add(focus, a.eye, -1)), step = Math.hypot(...add(b.eye, a.eye, -1));
    return dot(a.ahead, b.ahead) > STEADY && step < STEP * away;
  };
  const smooth = path.length > 2 && path.every((camera, i) => i === 0 || near(path[i - 1], camera));
  return smooth ? path : null;
}

// Return where the camera of a path is at a time, between the two that are nearest in time.
function poseOn(path, time) {
  const next = path.findIndex((camera) => camera.time > time);
  const [before, after] = [path[next < 0 ? path.length - 1 : Math.max(next - 1, 0)], path[next < 0 ? path.length - 1 : next]];
  const share = after.time > before.time ? clamp((time - before.time) / (after.time - before.time), 0, 1) : 0;
  const mixed = (name) => add(before[name].map((value) => (1 - share) * value), after[name], share);
  const ahead = unit(mixed("ahead")), right = unit(cross(mixed("down"), ahead));
  return { eye: mixed("eye"), ahead, right, down: cross(ahead, right) };
}

class Player {
  constructor(scenes) {
    this.canvas = byId("canvas");
    this.time = 0;
    this.speed = 1;
    this.onward = 1;
    this.loop = "repeat";
    this.layer = "all";
    this.behind = "own";
    this.trails = this.playing = false;
    this.scale = 0; // place in SCALES
    this.pace = 16; // milliseconds between frames, smoothed
    this.changed = this.touched = this.last = 0;
    this.waiting = [];
    this.windows = scenes.map((scene) => {
      const part = { scene, renderer: new Renderer(this.canvas, scene) };
      part.sorting = new Sorting(scene, (order) => {
        part.renderer.setOrder(order);
        this.stale = true;
        this.wake();
      });
      return part;
    });
    Object.assign(this, this.windows[0]);
    this.shown = [[this.windows[0], 1]];
    this.path = pathOf(this.scene);
    this.trust = (Math.max(this.scene.trust ?? TRUST, LEAST_TRUST) * Math.PI) / 180;
    this.held = false;
    document.body.classList.toggle("framed", this.path !== null);
    this.home();
  }

  // Return the windows of the film that are shown at a time, the one that it is of first, and their shares.
  shownAt(time) {
    const after = this.windows.findIndex(({ scene }) => scene.from > time);
    const number = (after < 0 ? this.windows.length : Math.max(after, 1)) - 1, part = this.windows[number];
    const { from, fade } = part.scene, next = this.windows[number + 1];
    if (number && time - from < fade) return [[part, 0.5 + (time - from) / (2 * fade)], [this.windows[number - 1]]];
    if (next && time > next.scene.from - fade) return [[part, 0.5 + (next.scene.from - time) / (2 * fade)], [next]];
    return [[part, 1]];
  }

  // Show the windows of the time, each in the right order at once.
  enter() {
    const shown = this.shownAt(this.time);
    for (const [part] of shown) {
      if (this.shown.some(([known]) => known === part)) continue;
      part.renderer.setTime(this.time);
      part.renderer.setOrder(new Sorter(part.scene).sorted(part.renderer.maps, this.eye));
    }
    const [[part]] = this.shown = shown;
    if (part.scene === this.scene) return;
    Object.assign(this, part);
    if (this.trails) this.setTrails(true);
  }

  // Look through the first camera, or along with the one that moved through the scene.
  home() {
    this.look(0);
    this.ride(this.path !== null);
  }

  // Go along with the camera that took the images: a drag leans the view within the angle that is trusted, and
  // it springs back. Else fly freely.
  ride(on) {
    this.riding = on && this.path !== null;
    this.pull = [0, 0]; // by how much the view was dragged, angles to the left and upwards
    this.zoom = 1;
    this.pan = [0, 0]; // of what the zoom cuts off, -1 to 1
    byId("free").setAttribute("aria-pressed", !this.riding);
    if (!this.riding) return;
    this.lens = this.path[0].lens;
    this.follow();
  }

  // Stand where the film's camera was at this time, leant aside.
  follow() {
    this.stand(poseOn(this.path, this.time));
    const pulled = Math.hypot(...this.pull), angle = this.trust * Math.tanh(pulled / this.trust);
    this.leant = angle / this.trust;
    if (!pulled) return;
    const target = add(this.eye, this.ahead, this.away), [left, upward] = unit([...this.pull]);
    const axis = unit(add(this.down.map((value) => -left * value), this.right, upward));
    for (const name of ["right", "down", "ahead"]) this[name] = unit(turned(this[name], axis, angle));
    this.eye = add(target, this.ahead, -this.away);
  }

  // Return the angle between the view and the film's camera of this time, seen from what that one looks at.
  beside() {
    const { eye, ahead } = poseOn(this.path, this.time), { focus } = this.scene;
    const target = add(eye, ahead, Math.max(dot(add(focus, eye, -1), ahead), 2 * this.lens.near));
    return Math.acos(clamp(dot(unit(add(this.eye, target, -1)), unit(add(eye, target, -1))), -1, 1));
  }

  // Show how far the view is beyond what is trusted, where somebody flies freely.
  showEdge() {
    const angle = this.path && !this.riding ? this.beside() : 0, degrees = (a) => `${Math.round((a * 180) / Math.PI)}°`;
    const beyond = clamp(angle / this.trust - 1, 0, 1);
    byId("edge").hidden = !beyond;
    byId("edge").style.opacity = 0.4 + 0.6 * beyond;
    byId("edge-text").textContent = `${degrees(angle)} beside the film, which shows up to ${degrees(this.trust)}`;
  }

  // Look through a camera of the file.
  look(number) {
    this.ride(false);
    this.camera = number;
    this.lens = this.scene.cameras[number].lens;
    this.stand(this.scene.cameras[number]);
  }

  // Stand where a camera stands.
  stand({ eye, right, down, ahead }) {
    const { scene: { focus }, lens: { near } } = this;
    Object.assign(this, { eye: [...eye], right: unit(right), down: unit(down), ahead: unit(ahead) });
    const along = dot(add(focus, eye, -1), this.ahead);
    this.away = along > 2 * near ? along : Math.max(Math.hypot(...add(focus, eye, -1)), 2 * near);
    this.changeView();
  }

  changeView() {
    this.stale = this.unsorted = true;
    this.changed = performance.now();
    this.wake();
  }

  setTime(time) {
    this.time = clamp(time, 0, 1);
    this.enter();
    if (this.riding) this.follow();
    this.untimed = this.stale = this.unsorted = true;
    this.changed = performance.now();
    this.wake();
  }

  // Turn about the point that the camera looks at, by angles to the left and upwards.
  turn(left, upward) {
    if (this.riding) {
      this.pull = add(this.pull, [left, upward]);
      this.released = performance.now() + HOLD;
      if (!this.held) setTimeout(() => this.wake(), HOLD);
      return this.follow();
    }
    const { right, scene: { up } } = this, target = add(this.eye, this.ahead, this.away);
    const height = Math.asin(clamp(dot(this.ahead, up), -1, 1));
    const lift = clamp(height + upward, -1.5, 1.5) - height;
    for (const name of ["right", "down", "ahead"]) {
      this[name] = unit(turned(turned(this[name], right, lift), up, left));
    }
    this.eye = add(target, this.ahead, -this.away);
    this.changeView();
  }

  // Shift what is seen by CSS pixels.
  shift(dx, dy) {
    if (this.riding) {
      const { clientWidth, clientHeight } = this.canvas, room = Math.max(this.zoom - 1, 1e-3);
      const moved = [(2 * dx) / (clientWidth * room), (2 * dy) / (clientHeight * room)];
      this.pan = add(this.pan, moved).map((value) => clamp(value, -1, 1));
      return this.changeView();
    }
    const { focal } = fitted(this.lens, this.canvas.clientWidth, this.canvas.clientHeight);
    this.eye = add(this.eye, this.right, (-dx * this.away) / focal[0]);
    this.eye = add(this.eye, this.down, (-dy * this.away) / focal[1]);
    this.changeView();
  }

  // Go nearer by a factor below 1, or farther.
  approach(factor) {
    if (this.riding) {
      this.zoom = clamp(this.zoom / factor, 1, MOST_ZOOM);
      return this.changeView();
    }
    const target = add(this.eye, this.ahead, this.away);
    this.away = Math.max(this.away * factor, 2 * this.lens.near);
    this.eye = add(target, this.ahead, -this.away);
    this.changeView();
  }

  play(on) {
    if (on && this.loop === "stop" && this.time >= 1) this.setTime(0);
    this.playing = on;
    this.last = 0;
    document.body.classList.toggle("playing", on);
    byId("play").setAttribute("aria-label", on ? "pause" : "play");
    this.stale = true;
    this.rouse();
    this.wake();
  }

  advance(milliseconds) {
    const { seconds } = this.scene;
    let time = this.time + (this.onward * this.speed * milliseconds) / (1000 * seconds);
    if (time >= 0 && time <= 1) return this.setTime(time);
    if (this.loop === "stop") {
      this.setTime(1);
      return this.play(false);
    }
    if (this.loop === "back") {
      this.onward = time > 1 ? -1 : 1;
      time = time > 1 ? 2 - time : -time;
    }
    return this.setTime(time - Math.floor(time));
  }

  moves() {
    return this.windows.some(({ scene }) => scene.moving > 0);
  }

  background() {
    return BEHIND[this.behind] ?? this.scene.background;
  }

  view(width, height) {
    const { eye, right, down, ahead } = this;
    const view = { eye, right, down, ahead, ...fitted(this.lens, width, height, this.path !== null) };
    if (!this.riding) return view;
    const scale = this.zoom * (1 + LEAN_CROP * this.leant ** 2);
    view.focal = view.focal.map((value) => scale * value);
    view.skew *= scale;
    view.middle = view.middle.map((value, i) => {
      const half = view.size[i] / 2;
      return half + scale * (value - half) + this.pan[i] * (this.zoom - 1) * half;
    });
    return view;
  }

  wake() {
    if (!this.frame) this.frame = requestAnimationFrame((now) => this.draw(now));
  }

  // Show the controls, which fade while the scene plays and nobody touches anything.
  rouse() {
    this.touched = performance.now();
    document.body.classList.remove("idle");
  }

  draw(now) {
    this.frame = 0;
    if (this.lost || this.measured) return;
    const gap = this.last ? now - this.last : 0;
    if (this.playing && gap) this.advance(Math.min(gap, 100));
    const lively = this.playing || performance.now() - this.changed < REST;
    if (lively && gap && gap < 1000) this.pace += 0.15 * (gap - this.pace);
    const quiet = performance.now() - this.touched > QUIET && byId("panel").hidden;
    if (this.playing && quiet) document.body.classList.add("idle");
    this.adapt(lively);
    this.springBack(gap);
    if (this.untimed) {
      for (const [{ renderer }] of this.shown) renderer.setTime(this.time);
      this.showTime();
    }
    if (this.unsorted) for (const [{ renderer, sorting }] of this.shown) sorting.ask(renderer.maps, this.eye);
    const { stale } = this;
    this.untimed = this.unsorted = this.stale = false;
    if (stale) this.paint(lively);
    this.last = lively ? now : 0;
    if (lively || this.stale) this.wake();
    if (this.playing || !(lively || this.stale || this.sorting.busy)) this.waiting.splice(0).forEach((tell) => tell());
  }

  // Let go of a lean that nobody holds any more.
  springBack(gap) {
    if (!this.riding || this.held || !Math.hypot(...this.pull) || performance.now() < this.released) return;
    const pull = this.pull.map((value) => clamp(value, -2 * this.trust, 2 * this.trust) * Math.exp(-Math.min(gap || 16, 400) / SPRING));
    this.pull = Math.hypot(...pull) > 1e-3 * this.trust ? pull : [0, 0];
    this.follow();
  }

  // Make pictures smaller while they come too slowly, and larger once they would not.
  adapt(lively) {
    if (!lively) return;
    const { scale, pace } = this;
    if (pace > SLOW && scale < SCALES.length - 1) this.scale++;
    else if (scale > 0 && pace * (SCALES[scale - 1] / SCALES[scale]) ** 2 < QUICK) this.scale--;
    if (this.scale !== scale) this.pace = 0.5 * (SLOW + QUICK);
  }

  paint(lively) {
    const scale = lively ? SCALES[this.scale] : 1;
    const [wide, high] = this.pixels ?? [this.canvas.clientWidth, this.canvas.clientHeight];
    const width = Math.max(1, Math.round(wide * scale)), height = Math.max(1, Math.round(high * scale));
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
    const view = this.view(width, height), trail = this.trails ? Math.max((1.6 * width) / this.canvas.clientWidth, 1) : 0;
    const [[part, share], [other] = []] = this.shown, fills = this.path !== null && this.behind === "own" && this.layer !== "moving";
    for (const { renderer } of other ? [other, part] : [part]) renderer.drawTarget(view, this.layer);
    if (other) other.renderer.drawCanvas(view, this.background(), fills);
    part.renderer.drawCanvas(view, this.background(), fills, trail, share);
    this.showEdge();
    if (scale !== 1) this.stale = true; // once more, sharply, when nothing moves any more
  }

  showTime() {
    const slider = byId("time"), seconds = this.time * this.scene.seconds;
    slider.value = this.time;
    slider.style.setProperty("--done", `${100 * this.time}%`);
    slider.setAttribute("aria-valuetext", `${seconds.toFixed(2)} of ${this.scene.seconds} seconds`);
    byId("clock").textContent = `${seconds.toFixed(2)} s`;
  }

  setTrails(on) {
    this.trails = on;
    if (on && !this.renderer.segments) this.renderer.setTrails(trailsOf(this.scene));
    byId("trails").setAttribute("aria-pressed", on);
    this.changeView();
  }

  // Set a choice of the panel, or the next one.
  choose(name, value) {
    const inputs = [...document.getElementsByName(name)].filter((input) => !input.disabled);
    const now = inputs.findIndex((input) => input.checked);
    const input = inputs.find((other) => other.value === value) ?? inputs[(now + 1) % inputs.length];
    input.checked = true;
    this.take(name, input.value);
  }

  take(name, value) {
    this[name] = name === "speed" ? Number(value) : value;
    if (name === "loop") this.onward = 1;
    if (name === "behind") {
      const rgb = this.background().map((part) => Math.round(255 * part));
      document.body.style.background = `rgb(${rgb})`;
    }
    this.stale = true;
    this.changed = performance.now();
    this.wake();
  }

  // Take the address: ?t=0.5&autoplay=1&camera=3, or the same after #.
  obey(reduced) {
    const asked = new URLSearchParams(location.search);
    new URLSearchParams(location.hash.slice(1)).forEach((value, key) => asked.set(key, value));
    const number = (key) => (asked.has(key) && asked.get(key).trim() !== "" ? Number(asked.get(key)) : NaN);
    const time = number("t"), camera = number("camera");
    if (Number.isInteger(camera) && camera >= 0 && camera < this.scene.cameras.length) this.look(camera);
    this.setTime(Number.isFinite(time) ? time : this.time);
    if (LAYERS.includes(asked.get("layer"))) this.choose("layer", asked.get("layer"));
    if (asked.get("trails") === "1") this.setTrails(true);
    document.body.classList.toggle("bare", asked.get("controls") === "0");
    const wanted = asked.has("autoplay") ? asked.get("autoplay") === "1" : !Number.isFinite(time);
    this.play(wanted && !reduced && this.moves());
  }

  // Resolve once what the page shows is sharp and in the right order; while it plays, at once.
  settled() {
    return new Promise((tell) => {
      this.waiting.push(tell);
      this.stale = true;
      this.wake();
    });
  }
}

// Connect the controls.
function connect(player) {
  const { canvas } = player, panel = byId("panel"), keys = byId("keys");
  const click = (id, action) => byId(id).addEventListener("click", action);
  const home = () => player.home(), next = () => byId("camera").hidden || player.look((player.camera + 1) % player.scene.cameras.length);
  const toggleHelp = () => {
    const { count, inMotion } = player.scene, { bits } = player.renderer;
    const sorted = player.sorting.milliseconds.toFixed(1);
    byId("about").textContent = `${count.toLocaleString("en")} particles, of which ${inMotion.toLocaleString("en")} move; ` +
      `blended in ${bits} bits, sorted in ${sorted} ms`;
    if (keys.open) keys.close();
    else keys.showModal();
  };
  const togglePanel = (on = panel.hidden) => {
    panel.hidden = !on;
    byId("more").setAttribute("aria-expanded", on);
  };
  const toggleWhole = () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen?.();
  };
  byId("whole").hidden = !document.fullscreenEnabled;
  byId("free").hidden = !player.path;
  for (const row of document.querySelectorAll("[data-of]")) row.hidden = byId(row.dataset.of).hidden;
  byId("camera").hidden = player.scene.cameras.length < 2 || player.path !== null;
  byId("layers").hidden = !player.scene.inMotion || player.scene.inMotion === player.scene.count;
  for (const name of ["play", "time", "clock", "trails"]) byId(name).disabled = !player.moves();
  click("play", () => player.play(!player.playing));
  click("home", home);
  click("whole", toggleWhole);
  click("more", () => togglePanel());
  click("trails", () => player.setTrails(!player.trails));
  click("camera", next);
  click("free", () => player.ride(!player.riding));
  click("help", toggleHelp);
  byId("time").addEventListener("input", ({ target }) => {
    player.play(false);
    player.setTime(Number(target.value));
  });
  for (const name of ["layer", "speed", "loop", "behind"]) {
    for (const input of document.getElementsByName(name)) {
      input.addEventListener("change", () => player.take(name, input.value));
    }
  }

  const actions = {
    " ": () => player.play(!player.playing), h: home, c: next, f: toggleWhole, v: () => togglePanel(), "?": toggleHelp,
    l: () => player.choose("loop"), b: () => player.choose("behind"), t: () => player.setTrails(!player.trails),
    r: () => player.path && player.ride(!player.riding), m: () => byId("layers").hidden || player.choose("layer"), "+": () => player.approach(0.9), "=": () => player.approach(0.9),
    "-": () => player.approach(1 / 0.9), ",": () => step(-1), ".": () => step(1),
    "[": () => speedUp(-1), "]": () => speedUp(1), escape: () => togglePanel(false),
  };
  function step(sign) {
    const { span: [first, last], curve } = player.scene;
    player.play(false);
    player.setTime(player.time + (sign * (last - first)) / (curve?.frames > 1 ? curve.frames - 1 : 50));
  }
  function speedUp(by) {
    const inputs = [...document.getElementsByName("speed")], at = inputs.findIndex((input) => input.checked);
    player.choose("speed", inputs[clamp(at + by, 0, inputs.length - 1)].value);
  }
  const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  addEventListener("keydown", (event) => {
    player.rouse();
    const { key, target, ctrlKey, metaKey, altKey, shiftKey } = event;
    if (ctrlKey || metaKey || altKey || keys.open) return;
    const of = (kinds) => Boolean(target.closest?.(kinds));
    if ((key === " " && of("button")) || (key in arrows && of("input, button"))) return; // pressed, moved
    if (key in arrows) {
      const [x, y] = arrows[key];
      if (shiftKey) player.shift(30 * x, 30 * y);
      else player.turn(-0.08 * x, -0.08 * y);
    } else if (actions[key.toLowerCase()]) {
      actions[key.toLowerCase()]();
    } else return;
    event.preventDefault();
  });

  // One pointer turns or shifts, two shift and approach.
  const pointers = new Map();
  const middle = () => {
    const all = [...pointers.values()], x = all.reduce((sum, p) => sum + p.x, 0) / all.length;
    const y = all.reduce((sum, p) => sum + p.y, 0) / all.length;
    return { x, y, apart: all.length > 1 ? Math.hypot(all[0].x - all[1].x, all[0].y - all[1].y) : 0 };
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    player.held = true;
    canvas.classList.add("held");
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, shifts: event.button === 2 || event.shiftKey });
  });
  canvas.addEventListener("pointermove", (event) => {
    const pointer = pointers.get(event.pointerId);
    if (!pointer) return;
    const before = middle();
    pointer.x = event.clientX;
    pointer.y = event.clientY;
    const after = middle(), dx = after.x - before.x, dy = after.y - before.y;
    if (pointers.size > 1 || pointer.shifts) player.shift(dx, dy);
    else {
      const angle = 3.2 / Math.min(canvas.clientWidth, canvas.clientHeight);
      player.turn(-angle * dx, -angle * dy);
    }
    if (before.apart && after.apart) player.approach(before.apart / after.apart);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => {
      pointers.delete(event.pointerId);
      player.held = pointers.size > 0;
      player.released = 0;
      player.wake();
      canvas.classList.toggle("held", pointers.size > 0);
    });
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", home);
  canvas.addEventListener("wheel", (event) => {
    // A page around this one scrolls on until somebody has clicked the scene.
    if (window.parent !== window && document.activeElement !== canvas) return;
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 30 : 1;
    player.approach(Math.exp(clamp(event.deltaY * lines, -300, 300) * (event.ctrlKey ? 0.008 : 0.0015)));
  }, { passive: false });
  for (const name of ["pointermove", "pointerdown"]) addEventListener(name, () => player.rouse());

  new ResizeObserver(([entry]) => {
    const [box] = entry.devicePixelContentBoxSize ?? [];
    const ratio = devicePixelRatio || 1, { width, height } = entry.contentRect;
    // Where a browser only imitates a device, the box is not in its pixels.
    const exact = box && Math.abs(box.inlineSize - width * ratio) < 2;
    player.pixels = exact ? [box.inlineSize, box.blockSize] : [Math.round(width * ratio), Math.round(height * ratio)];
    player.stale = true;
    player.changed = 0;
    player.wake();
  }).observe(canvas);
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    player.lost = true;
    tell("The graphics card was taken away; the scene comes back with it.");
  });
  canvas.addEventListener("webglcontextrestored", () => {
    for (const part of player.windows) part.renderer = new Renderer(canvas, part.scene);
    Object.assign(player, player.shown[0][0]);
    player.lost = false;
    if (player.trails) player.setTrails(true);
    player.setTime(player.time);
    tell("");
  });
}

// Say something in the middle of the page.
function tell(text) {
  byId("notice").textContent = text;
  byId("notice").hidden = !text;
}

// What scripts of other pages, and our tests, may ask.
function doorOf(player) {
  const reached = ({ width, height, time = player.time, camera = player.camera, layer = player.layer }) => {
    const { lens, ...pose } = player.scene.cameras[camera], view = { ...pose, ...fitted(lens, width, height) };
    const [first, second] = player.shownAt(time).map(([{ renderer, scene }, share]) => {
      renderer.setTime(time);
      renderer.setOrder(new Sorter(scene).sorted(renderer.maps, view.eye));
      renderer.drawTarget(view, layer);
      return { pixels: renderer.readTarget(), share };
    });
    player.shown = []; // what is on the page comes back
    player.setTime(player.time);
    return first.pixels.map((value, i) => (second ? first.share * value + (1 - first.share) * second.pixels[i] : value));
  };
  return {
    scene: player.scene, player, settled: () => player.settled(),
    // Premultiplied colour and coverage as floats, row by row from the top, of a camera of the file.
    pixels: reached,
    // Draw frames of a size while time passes and the camera turns: frames a second, and milliseconds of the
    // worker's sorting.
    async measure({ width, height, frames = 30 }) {
      const { renderer, sorting, scene } = player, one = new Uint8Array(4), sorts = [];
      let busy = 0, begin = 0;
      player.measured = true;
      for (let i = -1; i < frames; i++) {
        if (i === 0) [begin, busy] = [performance.now(), 0]; // the first frame makes ready
        const start = performance.now();
        renderer.setTime(Math.max(i, 0) / frames);
        player.turn(0.05, 0);
        sorting.ask(renderer.maps, player.eye);
        const view = player.view(width, height);
        player.canvas.width = width;
        player.canvas.height = height;
        renderer.drawTarget(view, player.layer);
        renderer.drawCanvas(view, scene.background);
        busy += performance.now() - start;
        renderer.gl.readPixels(0, 0, 1, 1, renderer.gl.RGBA, renderer.gl.UNSIGNED_BYTE, one); // waits for it
        await new Promise((done) => setTimeout(done));
        sorts.push(sorting.milliseconds);
      }
      const seconds = (performance.now() - begin) / 1000, mean = (of) => of.reduce((a, b) => a + b, 0) / of.length;
      player.measured = false;
      player.home();
      return {
        particles: scene.count, width, height, "frames a second": frames / seconds,
        "ms of sorting, in the worker": mean(sorts), "ms of the page's own code a frame": busy / frames,
      };
    },
  };
}

// Say why there is only a picture, without controls that would do nothing.
function giveUp(text) {
  document.body.classList.add("bare");
  tell(text);
  return null;
}

async function main() {
  const quiet = matchMedia("(prefers-reduced-motion: reduce)");
  try {
    if (!window.WebGL2RenderingContext || !document.createElement("canvas").getContext("webgl2")) {
      return giveUp("This browser has no WebGL 2, by which the scene would move: this is a picture of it.");
    }
    if (!window.DecompressionStream) {
      return giveUp("This browser is too old to unpack the scene: this is a picture of it.");
    }
    const scenes = readScene(await unpacked(byId("scene").textContent));
    byId("scene").remove();
    byId("canvas").hidden = false;
    const player = new Player(scenes);
    connect(player);
    player.renderer.setTime(0);
    player.renderer.setOrder(new Sorter(player.scene).sorted(player.renderer.maps, player.eye));
    player.obey(quiet.matches);
    addEventListener("hashchange", () => player.obey(quiet.matches));
    quiet.addEventListener("change", () => quiet.matches && player.play(false));
    player.paint(false);
    byId("poster").remove();
    return doorOf(player);
  } catch (error) {
    giveUp(`The scene cannot be shown: ${error.message}.`);
    throw error;
  }
}

window.forewarp = main();
