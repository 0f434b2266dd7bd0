// The page around the viewer: orbit controls, the capture's cameras, and the sliders of the test views.
"use strict";

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, by = 1) => [a[0] + by * b[0], a[1] + by * b[1], a[2] + by * b[2]];
const unit = (a) => { const size = Math.hypot(...a) || 1; return a.map((value) => value / size); };
const rows = (R) => [R.slice(0, 3), R.slice(3, 6), R.slice(6, 9)];

// Rotates a vector about a unit axis (Rodrigues).
function turned(vector, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), along = dot(axis, vector) * (1 - c), over = cross(axis, vector);
  return [0, 1, 2].map((i) => vector[i] * c + over[i] * s + axis[i] * along);
}

class Eye {
  constructor(up, target) { this.up = unit(up); this.target = target; }

  // The place of one of the capture's cameras; the target is as far away as the scene's.
  take(camera) {
    [this.right, this.down, this.forward] = rows(camera.rotation);
    this.camera = camera;
    const t = camera.translation;
    this.center = [0, 1, 2].map((i) => -(this.right[i] * t[0] + this.down[i] * t[1] + this.forward[i] * t[2]));
    this.distance = Math.max(dot(plus(this.target, this.center, -1), this.forward), 0.1);
  }

  orbit(yaw, pitch) {
    const focus = plus(this.center, this.forward, this.distance);
    const upright = Math.acos(Math.max(-1, Math.min(1, -dot(this.forward, this.up))));   // 0: straight down
    const tilt = Math.max(0.05 - upright, Math.min(Math.PI - 0.05 - upright, pitch));
    for (const [axis, angle] of [[this.right, tilt], [this.up, yaw]])
      for (const name of ["right", "down", "forward"]) this[name] = unit(turned(this[name], axis, angle));
    this.center = plus(focus, this.forward, -this.distance);
  }

  pan(x, y) { this.center = plus(plus(this.center, this.right, -x * this.distance), this.down, -y * this.distance); }

  zoom(by) {
    const nearer = this.distance * by;
    this.center = plus(this.center, this.forward, this.distance - nearer);
    this.distance = nearer;
  }

  // For a picture of this size: the whole view of the capture's camera fits into it.
  seen(width, height) {
    const { size, lens } = this.camera, by = Math.min(width / size[0], height / size[1]);
    const rotation = [...this.right, ...this.down, ...this.forward];
    const translation = rows(rotation).map((row) => -dot(row, this.center));
    const principal = [0.5 * width + (lens[2] - 0.5 * size[0]) * by, 0.5 * height + (lens[3] - 0.5 * size[1]) * by];
    return { rotation, translation, lens: [lens[0] * by, lens[1] * by, ...principal] };
  }
}

function startViewer(scene, model) {
  const canvas = document.getElementById("model-canvas"), marks = document.getElementById("model-cameras");
  const choice = document.getElementById("model-choice"), show = document.getElementById("model-show");
  const viewer = new SplatViewer(canvas, model), eye = new Eye(scene.up, scene.target);
  let wanted = false, places = [];

  function frame() {
    wanted = false;
    const ratio = Math.min(window.devicePixelRatio || 1, 1.5);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    const camera = eye.seen(width, height);
    viewer.draw(camera);
    drawMarks(camera, width, height);
  }

  function drawMarks(camera, width, height) {
    marks.width = width; marks.height = height;
    const paper = marks.getContext("2d"), R = rows(camera.rotation), [fx, fy, cx, cy] = camera.lens;
    places = [];
    if (!show.checked) return;
    scene.cameras.forEach((one, number) => {
      const [x, y, z] = R.map((row, axis) => dot(row, one.center) + camera.translation[axis]);
      if (z < 0.05) return;
      const place = [(fx * x) / z + cx, (fy * y) / z + cy];
      places.push([place, number]);
      paper.beginPath();
      paper.arc(...place, 5, 0, 2 * Math.PI);
      paper.fillStyle = one.test ? "#f2a03d" : "#4da3ff";
      paper.fill();
      paper.strokeStyle = "#ffffff";
      paper.stroke();
    });
  }

  const redraw = () => { if (!wanted) { wanted = true; requestAnimationFrame(frame); } };
  function look(number) {
    eye.take(scene.cameras[number]);
    choice.value = String(number);
    redraw();
  }

  scene.cameras.forEach((one, number) => choice.add(new Option(one.name + (one.test ? " (test)" : ""), number)));
  choice.onchange = () => look(Number(choice.value));
  show.onchange = redraw;
  const pointers = new Map();
  let moved = 0, active = false;   // the wheel scrolls the page until the model was pressed
  document.addEventListener("pointerdown", (event) => { active = event.target === canvas; });
  canvas.oncontextmenu = (event) => event.preventDefault();
  canvas.onpointerdown = (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
    moved = 0;
  };
  canvas.onpointermove = (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const x = (event.clientX - before.clientX) / canvas.clientHeight;
    const y = (event.clientY - before.clientY) / canvas.clientHeight;
    moved += Math.abs(x) + Math.abs(y);
    const others = [...pointers.values()].filter((pointer) => pointer.pointerId !== event.pointerId);
    if (others.length) {
      const apart = (pointer) => Math.hypot(pointer.clientX - others[0].clientX, pointer.clientY - others[0].clientY);
      eye.zoom(apart(before) / Math.max(apart(event), 1));
      eye.pan(0.5 * x, 0.5 * y);
    } else if (event.buttons & 2 || event.shiftKey) eye.pan(x, y);
    else eye.orbit(-3 * x, -3 * y);
    pointers.set(event.pointerId, event);
    redraw();
  };
  canvas.onpointerup = canvas.onpointercancel = (event) => {
    pointers.delete(event.pointerId);
    if (moved > 0.005 || event.type === "pointercancel") return;
    const ratio = canvas.width / canvas.clientWidth, box = canvas.getBoundingClientRect();
    const at = [(event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio];
    const near = places.map(([place, number]) => [Math.hypot(place[0] - at[0], place[1] - at[1]), number]);
    near.sort((a, b) => a[0] - b[0]);
    if (near.length && near[0][0] < 10 * ratio) look(near[0][1]);
  };
  canvas.addEventListener("wheel", (event) => {
    if (!active) return;
    event.preventDefault();
    eye.zoom(Math.exp(0.001 * Math.max(-300, Math.min(300, event.deltaY))));
    redraw();
  }, { passive: false });
  new ResizeObserver(redraw).observe(canvas);
  for (const button of document.querySelectorAll("[data-look]")) button.onclick = () => {
    look(Number(button.dataset.look));
    canvas.scrollIntoView({ block: "center" });
  };
  look(scene.first);
  return { look, eye, viewer };
}

function startSliders() {
  for (const block of document.querySelectorAll(".view")) {
    const slider = block.querySelector("input"), [, render, error] = block.querySelectorAll("img");
    const names = block.querySelector(".named");
    const wipe = () => {
      const value = Number(slider.value);
      const reveal = (share) => `inset(0 ${100 * (1 - Math.max(0, Math.min(1, share)))}% 0 0)`;
      render.style.clipPath = reveal(value);
      error.style.clipPath = reveal(value - 1);
      names.textContent = value < 0.02 ? "photo" : value < 0.98 ? "render | photo" : value < 1.02 ? "render"
        : value < 1.98 ? "error | render" : "error";
    };
    slider.oninput = wipe;
    wipe();
  }
}

startSliders();
(async () => {
  const status = document.getElementById("model-status");
  try {
    const scene = JSON.parse(document.getElementById("scene").textContent);
    const planes = await inflate(fromBase64(document.getElementById("model").textContent));
    window.turbogs = startViewer(scene, { ...scene.model, planes });
    status.remove();
  } catch (error) {
    status.textContent = `The model cannot be shown: ${error.message}.`;
  }
})();
