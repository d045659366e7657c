(() => {
  const canvas = document.getElementById("scene"), pen = canvas.getContext("2d");
  const scene = JSON.parse(document.getElementById("scene-data").textContent);
  const order = [scene.right, scene.ahead, scene.up], letters = order.map(i => "xyz"[i]);
  const shown = p => [p[order[0]], p[order[1]], scene.sign * p[order[2]]];
  const lines = scene.lines.map(l => ({...l, pieces: l.pieces.map(q => q.map(shown))}));
  const low = [1e99, 1e99, 1e99], high = [-1e99, -1e99, -1e99];
  for (const l of lines) for (const q of l.pieces) for (const p of q) for (let i = 0; i < 3; i++) {
    low[i] = Math.min(low[i], p[i]); high[i] = Math.max(high[i], p[i]);
  }
  const middle = low.map((v, i) => (v + high[i]) / 2);
  const size = Math.max(Math.hypot(...low.map((v, i) => high[i] - v)), 1e-3);
  let yaw, pitch, zoom, held = null;
  const reset = () => { yaw = -0.5; pitch = 0.5; zoom = 1; };
  const turned = p => {  // to the right, up on the page, away from the viewer
    const [x, y, z] = p, c = Math.cos(yaw), s = Math.sin(yaw);
    const a = c * x - s * y, b = s * x + c * y;
    return [a, Math.sin(pitch) * b + Math.cos(pitch) * z, Math.cos(pitch) * b - Math.sin(pitch) * z];
  };
  const round = v => { const p = 10 ** Math.floor(Math.log10(v)); return (v >= 5 * p ? 5 : v >= 2 * p ? 2 : 1) * p; };
  const segment = (x1, y1, x2, y2) => { pen.beginPath(); pen.moveTo(x1, y1); pen.lineTo(x2, y2); pen.stroke(); };
  function draw() {
    const width = canvas.clientWidth, height = canvas.clientHeight, dots = window.devicePixelRatio || 1;
    canvas.width = width * dots; canvas.height = height * dots;
    pen.setTransform(dots, 0, 0, dots, 0, 0);
    pen.fillStyle = "white"; pen.fillRect(0, 0, width, height);
    const scale = 0.9 * Math.min(width, height) / size * zoom;
    const at = p => { const t = turned(p.map((v, i) => v - middle[i])); return [width / 2 + scale * t[0], height / 2 - scale * t[1]]; };
    pen.font = "13px sans-serif"; pen.lineWidth = 1;
    const ground = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([i, j]) => at([i ? high[0] : low[0], j ? high[1] : low[1], low[2]]));
    pen.strokeStyle = "#ccc"; pen.beginPath();
    ground.forEach((g, i) => i ? pen.lineTo(...g) : pen.moveTo(...g)); pen.closePath(); pen.stroke();
    pen.lineWidth = 1.6; pen.lineJoin = "round";
    for (const l of lines[0].dash.length ? [...lines.slice(1), lines[0]] : lines) {
      pen.strokeStyle = l.colour; pen.setLineDash(l.dash); pen.beginPath();
      for (const q of l.pieces) q.forEach((p, i) => i ? pen.lineTo(...at(p)) : pen.moveTo(...at(p)));
      pen.stroke();
    }
    pen.setLineDash([]);
    const start = at(lines[0].pieces[0][0]);
    pen.beginPath(); pen.arc(...start, 4, 0, 7); pen.fillStyle = "white"; pen.fill(); pen.strokeStyle = "black"; pen.lineWidth = 1; pen.stroke();
    pen.fillStyle = "black"; pen.textAlign = "center"; pen.textBaseline = "middle";
    [[1, 0, 0], [0, 1, 0], [0, 0, scene.sign]].forEach((axis, i) => {
      const [a, b] = turned(axis); segment(60, height - 75, 60 + 36 * a, height - 75 - 36 * b);
      pen.fillText(letters[i], 60 + 48 * a, height - 75 - 48 * b);
    });
    const bar = round(0.3 * width / scale);
    pen.lineWidth = 2; segment(width - 30 - bar * scale, height - 22, width - 30, height - 22);
    pen.textAlign = "right"; pen.fillText(`${+bar.toPrecision(1)} m`, width - 30, height - 36);
  }
  const turn = (x, y) => { yaw += x; pitch = Math.max(-1.571, Math.min(1.571, pitch + y)); draw(); };
  const nearer = f => { zoom = Math.max(0.2, Math.min(200, zoom * f)); draw(); };
  canvas.addEventListener("pointerdown", e => { held = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointermove", e => {
    if (held) { turn((e.clientX - held[0]) / 150, (e.clientY - held[1]) / 150); held = [e.clientX, e.clientY]; }
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { held = null; });
  canvas.addEventListener("wheel", e => { if (e.ctrlKey || document.activeElement === canvas) { e.preventDefault(); nearer(Math.exp(-e.deltaY / 500)); } }, {passive: false});
  canvas.addEventListener("dblclick", () => { reset(); draw(); });
  const keys = {ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, -0.1), ArrowDown: () => turn(0, 0.1), "+": () => nearer(1.2), "-": () => nearer(1 / 1.2), Home: () => { reset(); draw(); }};
  canvas.addEventListener("keydown", e => { if (keys[e.key]) { e.preventDefault(); keys[e.key](); } });
  window.addEventListener("resize", draw);
  reset(); document.documentElement.classList.add("turns"); draw();
})();
