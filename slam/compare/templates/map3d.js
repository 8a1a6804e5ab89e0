// The maps in three dimensions on a canvas, turned by mouse, touch or arrow keys. Nothing is loaded from elsewhere.
"use strict";
document.querySelectorAll(".map3d").forEach(function (figure) {
  const data = JSON.parse(figure.querySelector("script").textContent);
  const canvas = figure.querySelector("canvas"), tools = figure.querySelector(".tools"), g = canvas.getContext("2d");
  const shown = data.layers.map(function () { return true; });
  const all = data.layers.flatMap(function (l) { return l.path.concat(l.points); }).concat(data.truth);
  const ranges = [0, 1, 2].map(function (c) { return range(all.map(function (p) { return p[c]; })); });
  const middle = ranges.map(function (r) { return (r[0] + r[1]) / 2; });
  let yaw, pitch, zoom, view, asked = false;
  const circle = Array.from({ length: 17 }, function (_, i) { return [Math.cos(i * Math.PI / 8), Math.sin(i * Math.PI / 8)]; });
  const fingers = new Map();

  // All but the outermost hundredth on either side: a few landmarks far off shall not make the rest small.
  function range(values) {
    const sorted = values.sort(function (a, b) { return a - b; }), n = sorted.length - 1;
    return n < 0 ? [0, 0] : [sorted[Math.floor(0.01 * n)], sorted[Math.ceil(0.99 * n)]];
  }
  // Camera axes: x right, y down, z forward. Seen from behind and above; [m] in the plane of the picture.
  function turned(p) {
    const cy = Math.cos(yaw), sy = Math.sin(yaw), x = p[0] - middle[0], z = p[2] - middle[2];
    return [cy * x + sy * z, Math.cos(pitch) * (p[1] - middle[1]) - Math.sin(pitch) * (-sy * x + cy * z)];
  }
  function reset(y, p) {
    yaw = y; pitch = p; zoom = 1;
    const seen = all.map(turned);
    view = [0, 1].map(function (c) { return range(seen.map(function (q) { return q[c]; })); });
    redraw();
  }
  function redraw() { if (!asked) { asked = true; requestAnimationFrame(draw); } }

  function draw() {
    asked = false;
    const scale = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
    if (canvas.width !== Math.round(w * scale) || canvas.height !== Math.round(h * scale)) {
      canvas.width = Math.round(w * scale); canvas.height = Math.round(h * scale);
    }
    g.setTransform(scale, 0, 0, scale, 0, 0);
    g.clearRect(0, 0, w, h);
    const s = zoom * 0.85 * Math.min(w / Math.max(0.1, view[0][1] - view[0][0]), h / Math.max(0.1, view[1][1] - view[1][0]));
    const left = (view[0][0] + view[0][1]) / 2, top = (view[1][0] + view[1][1]) / 2;
    function at(p) {
      const q = turned(p);
      return [w / 2 + s * (q[0] - left), h / 2 + s * (q[1] - top)];
    }
    function line(points, colour, width, dash) {
      g.beginPath(); g.strokeStyle = colour; g.lineWidth = width; g.setLineDash(dash || []);
      points.forEach(function (p, i) { const q = at(p); if (i) g.lineTo(q[0], q[1]); else g.moveTo(q[0], q[1]); });
      g.stroke();
    }
    data.layers.forEach(function (layer, k) {
      if (!shown[k]) return;
      g.strokeStyle = layer.colour; g.fillStyle = layer.colour; g.lineWidth = 0.7; g.setLineDash([]);
      layer.points.forEach(function (p, i) {
        const a = layer.axes[i];
        g.globalAlpha = 0.45;
        g.beginPath();
        [[0, 3], [0, 6], [3, 6]].forEach(function (pair) {
          circle.forEach(function (cs, j) {
            const q = at([0, 1, 2].map(function (c) { return p[c] + cs[0] * a[pair[0] + c] + cs[1] * a[pair[1] + c]; }));
            if (j) g.lineTo(q[0], q[1]); else g.moveTo(q[0], q[1]);
          });
        });
        g.stroke();
        const o = at(p);
        g.globalAlpha = 0.9;
        g.fillRect(o[0] - 0.8, o[1] - 0.8, 1.6, 1.6);
      });
      g.globalAlpha = 1;
      line(layer.path, layer.colour, 2.2);
    });
    if (data.truth.length) line(data.truth, "#444", 1.1, [5, 4]);
    ruler(w, h, s);
  }

  function ruler(w, h, s) {
    const rough = 0.25 * w / s, power = Math.pow(10, Math.floor(Math.log10(rough)));
    const length = [5, 2, 1].map(function (m) { return m * power; }).find(function (l) { return l <= rough; });
    g.setLineDash([]); g.strokeStyle = "#333"; g.fillStyle = "#333"; g.lineWidth = 1.5;
    g.beginPath(); g.moveTo(12, h - 14); g.lineTo(12 + length * s, h - 14); g.stroke();
    g.font = "12px system-ui, sans-serif"; g.fillText(Number(length.toPrecision(1)) + " m", 12, h - 19);
  }

  canvas.addEventListener("pointerdown", function (e) { canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]); });
  ["pointerup", "pointercancel"].forEach(function (n) { canvas.addEventListener(n, function (e) { fingers.delete(e.pointerId); }); });
  canvas.addEventListener("pointermove", function (e) {
    const before = fingers.get(e.pointerId);
    if (!before) return;
    if (fingers.size === 1) {
      yaw += 0.008 * (e.clientX - before[0]);
      pitch = Math.max(-1.57, Math.min(1.57, pitch + 0.008 * (e.clientY - before[1])));
    } else {
      const other = Array.from(fingers.entries()).find(function (f) { return f[0] !== e.pointerId; })[1];
      const was = Math.hypot(before[0] - other[0], before[1] - other[1]), is = Math.hypot(e.clientX - other[0], e.clientY - other[1]);
      if (was > 1) zoom = Math.max(0.2, Math.min(50, zoom * is / was));
    }
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    redraw();
  });
  canvas.addEventListener("wheel", function (e) {
    if (!e.ctrlKey && document.activeElement !== canvas) return; // else the page could not be scrolled past the picture
    e.preventDefault();
    zoom = Math.max(0.2, Math.min(50, zoom * Math.exp(-0.002 * e.deltaY)));
    redraw();
  }, { passive: false });
  canvas.addEventListener("keydown", function (e) {
    const step = { ArrowLeft: [-0.1, 0, 1], ArrowRight: [0.1, 0, 1], ArrowUp: [0, -0.1, 1], ArrowDown: [0, 0.1, 1], "+": [0, 0, 1.25], "-": [0, 0, 0.8] }[e.key];
    if (!step) return;
    e.preventDefault();
    yaw += step[0]; pitch = Math.max(-1.57, Math.min(1.57, pitch + step[1])); zoom *= step[2];
    redraw();
  });
  function button(text, action) {
    const b = document.createElement("button");
    b.type = "button"; b.textContent = text;
    b.addEventListener("click", function () { action(b); });
    tools.appendChild(b);
    return b;
  }
  data.layers.forEach(function (layer, k) {
    const b = button(layer.name, function (own) { shown[k] = !shown[k]; own.setAttribute("aria-pressed", shown[k]); redraw(); });
    b.style.borderColor = layer.colour; b.style.color = layer.colour; b.setAttribute("aria-pressed", true);
  });
  button("top", function () { reset(0, 1.57); });
  button("behind", function () { reset(0, 0); });
  button("askew", function () { reset(-0.5, 0.6); });
  button("+", function () { zoom *= 1.25; redraw(); });
  button("−", function () { zoom *= 0.8; redraw(); });
  if (window.ResizeObserver) new ResizeObserver(redraw).observe(canvas);
  reset(-0.5, 0.6);
});
