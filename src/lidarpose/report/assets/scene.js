"use strict";
// A small 3D viewer on a 2D canvas: lines, polygons, dots and labels in metres, turned by mouse, finger or keys.
(function () {
  const data = JSON.parse(document.getElementById("scene-data").textContent);
  const canvas = document.getElementById("scene");
  const pen = canvas.getContext("2d");
  const slider = document.getElementById("scene-angle");
  const readout = document.getElementById("scene-angle-text");
  const view = { turn: data.view[0], tilt: data.view[1], zoom: 1, shiftX: 0, shiftY: 0 };
  const start = Object.assign({}, view);
  let pending = false;
  let fitted = null;

  const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => { const l = Math.hypot(a[0], a[1], a[2]); return [a[0] / l, a[1] / l, a[2] / l]; };
  const [side, front, up] = data.frame;

  // The eye's own axes: right, down, away.
  function eyeAxes() {
    const ct = Math.cos(view.turn), st = Math.sin(view.turn), ci = Math.cos(view.tilt), si = Math.sin(view.tilt);
    const flat = [0, 1, 2].map((k) => ct * front[k] + st * side[k]);
    const away = [0, 1, 2].map((k) => ci * flat[k] - si * up[k]);
    const right = unit(cross(flat, up));
    return { right: right, down: cross(away, right), away: away };
  }

  const distance = 3.2 * data.radius;
  function bare(eye, p) {
    const d = sub(p, data.centre);
    const depth = distance + dot(d, eye.away);
    const f = depth > 0.05 * data.radius ? 1 / depth : NaN;
    return [f * dot(d, eye.right), f * dot(d, eye.down), depth];
  }

  // The first look fills the canvas; turning keeps its scale.
  function fit(width, height) {
    const seen = data.rim.map((p) => bare(eyeAxes(), p));
    const box = [0, 1].map((k) => [Math.min(...seen.map((p) => p[k])), Math.max(...seen.map((p) => p[k]))]);
    const room = [width - 2 * Math.min(90, width * 0.14), height - 70];
    const scale = Math.min(room[0] / (box[0][1] - box[0][0] || 1), room[1] / (box[1][1] - box[1][0] || 1));
    return { scale: scale, x: -scale * (box[0][0] + box[0][1]) / 2, y: -scale * (box[1][0] + box[1][1]) / 2 };
  }

  function projector(width, height) {
    const eye = eyeAxes();
    if (!fitted || fitted.width !== width) fitted = Object.assign({ width: width }, fit(width, height));
    return (p) => {
      const q = bare(eye, p), s = fitted.scale * view.zoom;
      return [
        width / 2 + view.shiftX + view.zoom * fitted.x + s * q[0],
        height / 2 + view.shiftY + view.zoom * fitted.y + s * q[1],
        q[2],
      ];
    };
  }

  function moved(item) {
    if (!item.moves || !slider) return item.points;
    const m = data.motion, M = m.table;
    // The slider shows readings; the table stands where they say it does.
    const a = (m.origin + m.scale * (slider.value - m.origin)) * Math.PI / 180, c = Math.cos(a), s = Math.sin(a);
    return item.points.map((p) => {
      const q = [c * p[0] - s * p[1], s * p[0] + c * p[1], p[2]];
      return [0, 1, 2].map((k) => M[k][0] * q[0] + M[k][1] * q[1] + M[k][2] * q[2] + M[k][3]);
    });
  }

  function drawItem(item, shape, colour) {
    pen.strokeStyle = pen.fillStyle = colour;
    pen.globalAlpha = item.alpha === undefined ? 1 : item.alpha;
    pen.lineWidth = item.width || 1.5;
    pen.setLineDash(item.dash || []);
    if (item.type === "points") {
      const r = item.size || 1.5;
      for (const p of shape) pen.fillRect(p[0] - r, p[1] - r, 2 * r, 2 * r);
      return;
    }
    pen.beginPath();
    shape.forEach((p, k) => (k ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1])));
    if (item.type === "polygon") { pen.closePath(); pen.fill(); pen.globalAlpha = Math.min(1, 3 * pen.globalAlpha); }
    pen.stroke();
  }

  function drawLabels(labels, style, width, height) {
    pen.globalAlpha = 1;
    pen.font = "13px " + style.fontFamily;
    pen.textBaseline = "middle";
    pen.lineJoin = "round";
    const taken = [];
    for (const l of labels) {
      const w = pen.measureText(l.text).width;
      const spots = [[9, 0], [-9 - w, 0], [-w / 2, -15], [-w / 2, 15], [9, 15], [9, -15]];
      for (const s of spots) {
        const x = l.at[0] + s[0], y = l.at[1] + s[1];
        const box = [x - 3, y - 10, x + w + 3, y + 10];
        if (box[0] < 2 || box[2] > width - 2 || box[1] < 2 || box[3] > height - 2) continue;
        if (taken.some((t) => box[0] < t[2] && t[0] < box[2] && box[1] < t[3] && t[1] < box[3])) continue;
        taken.push(box);
        pen.lineWidth = 4;
        pen.setLineDash([]);
        pen.strokeStyle = style.getPropertyValue("--bg");
        pen.strokeText(l.text, x, y);
        pen.fillStyle = style.getPropertyValue(l.colour) || l.colour;
        pen.fillText(l.text, x, y);
        break;
      }
    }
  }

  function draw() {
    pending = false;
    const width = canvas.clientWidth, height = canvas.clientHeight, ratio = window.devicePixelRatio || 1;
    if (!width) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const style = getComputedStyle(document.body);
    const root = getComputedStyle(document.documentElement);
    const project = projector(width, height);
    const labels = [];
    const shapes = [];
    for (const item of data.items) {
      const shape = moved(item).map(project).filter((p) => isFinite(p[0]));
      if (!shape.length) continue;
      if (item.type === "label") { labels.push({ at: shape[0], text: item.text, colour: item.colour }); continue; }
      shapes.push({ item: item, shape: shape, depth: shape.reduce((sum, p) => sum + p[2], 0) / shape.length });
    }
    shapes.sort((a, b) => b.depth - a.depth);
    for (const s of shapes) drawItem(s.item, s.shape, root.getPropertyValue(s.item.colour) || s.item.colour);
    const both = { fontFamily: style.fontFamily, getPropertyValue: (n) => root.getPropertyValue(n) };
    drawLabels(labels, both, width, height);
    if (slider) tell();
    canvas.dataset.drawn = String(shapes.length);
    canvas.dataset.view = [view.turn, view.tilt, view.zoom].map((v) => v.toFixed(4)).join(" ");
  }

  function tell() {
    const degrees = Number(slider.value);
    const row = data.motion.sigma && data.motion.sigma[Math.round((degrees + 180) / data.motion.step)];
    readout.textContent = degrees.toFixed(0).replace("-", "\u2212") + "°" +
      (row ? "  ±" + row[0] + " mm  ±" + row[1] + "°" : "");
  }

  function redraw() { if (!pending) { pending = true; requestAnimationFrame(draw); } }
  function turnBy(dx, dy) {
    view.turn += dx * 0.008;
    view.tilt = Math.max(-1.5, Math.min(1.5, view.tilt + dy * 0.008));
    redraw();
  }
  function zoomBy(factor) { view.zoom = Math.max(0.3, Math.min(12, view.zoom * factor)); redraw(); }

  const touches = new Map();
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    touches.set(e.pointerId, [e.clientX, e.clientY]);
  });
  canvas.addEventListener("pointermove", (e) => {
    const last = touches.get(e.pointerId);
    if (!last) return;
    const now = [e.clientX, e.clientY];
    if (touches.size === 1) {
      if (e.shiftKey) { view.shiftX += now[0] - last[0]; view.shiftY += now[1] - last[1]; redraw(); }
      else turnBy(now[0] - last[0], now[1] - last[1]);
    } else if (touches.size === 2) {
      const other = [...touches].find(([id]) => id !== e.pointerId)[1];
      const before = Math.hypot(last[0] - other[0], last[1] - other[1]);
      const after = Math.hypot(now[0] - other[0], now[1] - other[1]);
      view.shiftX += (now[0] - last[0]) / 2;
      view.shiftY += (now[1] - last[1]) / 2;
      zoomBy(before > 1 ? after / before : 1);
    }
    touches.set(e.pointerId, now);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (e) => touches.delete(e.pointerId));
  // A bare wheel scrolls the page; with ctrl (or a pinch on a touch pad) it zooms the scene.
  canvas.addEventListener("wheel", (e) => {
    if (!e.ctrlKey && !e.metaKey) return;
    e.preventDefault();
    zoomBy(Math.exp(-e.deltaY * 0.004));
  }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const steps = { ArrowLeft: [-20, 0], ArrowRight: [20, 0], ArrowUp: [0, -20], ArrowDown: [0, 20] };
    if (steps[e.key]) turnBy(...steps[e.key]);
    else if (e.key === "+" || e.key === "=") zoomBy(1.2);
    else if (e.key === "-") zoomBy(1 / 1.2);
    else return;
    e.preventDefault();
  });
  for (const b of document.querySelectorAll("[data-scene]")) {
    b.addEventListener("click", () => {
      if (b.dataset.scene === "nearer") zoomBy(1.25);
      else if (b.dataset.scene === "farther") zoomBy(0.8);
      else { Object.assign(view, start); redraw(); }
    });
  }
  if (slider) slider.addEventListener("input", redraw);
  window.addEventListener("resize", redraw);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  draw();
})();
