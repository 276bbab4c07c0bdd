// The drawn map: zooms, pans, colours by kind or confidence, tells what lies under the pointer, jumps to what is asked.
(async () => {
  const city = JSON.parse(document.getElementById("city-data").textContent);
  const sheet = document.querySelector(".sheet");
  const canvas = sheet.querySelector("canvas");
  const context = canvas.getContext("2d");
  const map = await unpacked(city);
  const view = { x: 0, y: 0, scale: 1 };
  const state = { mode: "kind", shown: [true, true, true], truth: true, doubts: true, row: -1, at: null, hover: -1 };
  const RAMP = [[226, 74, 51], [244, 165, 96], [240, 225, 175], [127, 190, 220], [86, 160, 233]];
  const ramp = (share) => {
    const at = Math.min(Math.max(share, 0), 1) * (RAMP.length - 1), low = Math.min(Math.floor(at), RAMP.length - 2);
    return `rgb(${RAMP[low].map((channel, i) => Math.round(channel + (at - low) * (RAMP[low + 1][i] - channel)))})`;
  };
  const LEVELS = 8;
  const level = (confidence) => Math.min(LEVELS - 1, Math.floor((confidence / 255 - 0.5) * 2 * LEVELS)); // 0.5 to 1
  const opacity = (confidence) => 0.4 + 0.6 * Math.min(1, confidence / 255);

  async function unpacked(data) {
    const bytes = Uint8Array.from(atob(data.packed), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const buffer = await new Response(stream).arrayBuffer();
    const n = data.elements, points = new Float32Array(2 * data.points), code = new Uint8Array(buffer);
    const found = {
      n, points, row: new Uint32Array(buffer, 0, n), count: new Uint32Array(buffer, 4 * n, n),
      frames: new Uint16Array(buffer, 8 * n, n), kind: new Uint8Array(buffer, 10 * n, n),
      confidence: new Uint8Array(buffer, 11 * n, n), deviation: new Uint8Array(buffer, 12 * n, n),
      start: new Uint32Array(n + 1), box: new Float32Array(4 * n),
    };
    let place = 13 * n;
    const next = () => {
      let value = 0, factor = 1, byte;
      do { byte = code[place++]; value += (byte & 127) * factor; factor *= 128; } while (byte & 128);
      return value % 2 ? -(value + 1) / 2 : value / 2;
    };
    let x = 0, y = 0, at = 0;
    for (let i = 0; i < n; i++) {
      found.start[i] = at;
      let west = Infinity, south = Infinity, east = -Infinity, north = -Infinity;
      for (let k = found.count[i]; k > 0; k--, at++) {
        x += next(); y += next();
        const px = (points[2 * at] = x * data.step), py = (points[2 * at + 1] = y * data.step);
        if (px < west) west = px; if (px > east) east = px; if (py < south) south = py; if (py > north) north = py;
      }
      found.box.set([west, south, east, north], 4 * i);
    }
    found.start[n] = at;
    return found;
  }

  const toScreen = (x, y) => [(x - view.x) * view.scale + width / 2, (view.y - y) * view.scale + height / 2];
  const toSheet = (px, py) => [(px - width / 2) / view.scale + view.x, view.y - (py - height / 2) / view.scale];
  let width = 1, height = 1, waiting = false;
  const draw = () => { if (!waiting) { waiting = true; requestAnimationFrame(paint); } };

  function visible(i) {
    return map.kind[i] < 3 ? state.shown[map.kind[i]] : state.truth && state.shown[map.kind[i] - 3];
  }

  function trace(i) { // skips points that fall on the pixel of the one before
    const end = map.start[i + 1], points = map.points;
    let k = map.start[i], [lastX, lastY] = toScreen(points[2 * k], points[2 * k + 1]);
    context.moveTo(lastX, lastY);
    for (k++; k < end; k++) {
      const px = (points[2 * k] - view.x) * view.scale + width / 2, py = (view.y - points[2 * k + 1]) * view.scale + height / 2;
      if (k === end - 1 || Math.abs(px - lastX) + Math.abs(py - lastY) > 0.9) { context.lineTo(px, py); lastX = px; lastY = py; }
    }
  }

  function paint() {
    waiting = false;
    const ratio = window.devicePixelRatio || 1;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = city.background;
    context.fillRect(0, 0, width, height);
    drawPlaces();
    const [west, north] = toSheet(-20, -20), [east, south] = toSheet(width + 20, height + 20);
    const buckets = new Map();
    for (let i = 0; i < map.n; i++) {
      const b = 4 * i;
      if (map.box[b] > east || map.box[b + 2] < west || map.box[b + 1] > north || map.box[b + 3] < south || !visible(i)) continue;
      const dim = state.row >= 0 && map.row[i] !== state.row ? 1 : 0;
      const key = map.kind[i] * 100 + level(map.confidence[i]) * 10 + dim + (map.kind[i] >= 3 ? -1000 : 0);
      (buckets.get(key) || buckets.set(key, []).get(key)).push(i);
    }
    context.lineJoin = context.lineCap = "round";
    const thin = Math.min(1, Math.max(0.35, view.scale / 0.6));
    for (const key of [...buckets.keys()].sort((a, b) => a - b)) {
      const some = buckets.get(key), kind = map.kind[some[0]], truth = kind >= 3;
      context.beginPath();
      some.forEach(trace);
      context.globalAlpha = (key % 2 ? 0.16 : 1) * (state.mode === "kind" && !truth ? opacity(map.confidence[some[0]]) : 1);
      context.strokeStyle = truth ? city.truth : state.mode === "kind" ? city.kinds[kind].colour
        : ramp((level(map.confidence[some[0]]) + 0.5) / LEVELS);
      context.lineWidth = (kind % 3 === 2 ? 2 : 1.5) * thin * (view.scale > 6 ? 1.4 : 1);
      if (kind === 0 && state.mode === "kind" && view.scale > 0.6) {
        context.fillStyle = context.strokeStyle;
        const alpha = context.globalAlpha; context.globalAlpha = 0.22 * alpha; context.fill("evenodd"); context.globalAlpha = alpha;
      }
      context.stroke();
    }
    context.globalAlpha = 1;
    if (state.doubts) drawDoubts();
    for (const i of [state.hover]) if (i >= 0) {
      context.beginPath(); trace(i); context.strokeStyle = "#fff"; context.lineWidth = 3; context.stroke();
    }
    drawScale();
  }

  function drawPlaces() {
    context.font = "500 12px Inter, system-ui, sans-serif";
    for (const place of city.places) {
      const [x, y] = toScreen(place.low[0], place.high[1]), [right, bottom] = toScreen(place.high[0], place.low[1]);
      if (city.places.length < 2 || right - x < 3) continue;
      const pad = Math.min(14, 12 * view.scale + 3);
      context.strokeStyle = "rgba(255,255,255,.10)"; context.lineWidth = 1;
      context.strokeRect(x - pad, y - pad, right - x + 2 * pad, bottom - y + 2 * pad);
      if (right - x > 60) {
        context.fillStyle = "rgba(220,226,236,.62)";
        const room = right - x + 2 * pad; let name = place.name;
        while (name.length > 3 && context.measureText(name).width > room) name = name.slice(0, -2) + "…";
        context.fillText(name, x - pad, y - pad - 6);
      }
    }
  }

  function drawDoubts() { // the stretch itself, or a dot where it is too small to see
    context.strokeStyle = context.fillStyle = city.doubt;
    city.doubts.forEach((doubt, number) => {
      const [x, y] = toScreen(doubt.x, doubt.y), on = number === state.at, reach = doubt.length * view.scale;
      if (x < -reach || y < -reach || x > width + reach || y > height + reach) return;
      context.beginPath();
      if (reach < 8) { context.globalAlpha = 0.75; context.arc(x, y, on ? 4 : 1.6, 0, 7); context.fill(); }
      else {
        doubt.line.forEach(([a, b], k) => (k ? context.lineTo : context.moveTo).apply(context, toScreen(a, b)));
        context.globalAlpha = on ? 0.95 : view.scale > 2 ? 0.6 : 0.45; context.lineWidth = on ? 5 : view.scale > 2 ? 3 : 2; context.stroke();
      }
      if (on && reach < 60) { context.globalAlpha = 1; context.beginPath(); context.arc(x, y, 40, 0, 7); context.lineWidth = 1.2; context.stroke(); }
    });
    context.globalAlpha = 1;
  }

  function drawScale() {
    const steps = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000, 20000, 50000];
    const metres = steps.find((step) => step * view.scale > 70) || 100000, bar = sheet.querySelector(".scale");
    bar.firstChild.textContent = metres >= 1000 ? `${metres / 1000} km` : `${metres} m`;
    bar.lastChild.style.width = `${metres * view.scale}px`;
  }

  function fit(low, high, least = 30) {
    const w = Math.max(high[0] - low[0], least), h = Math.max(high[1] - low[1], least);
    const scale = Math.min((width - 60) / w, (height - 130) / h); // the bar of buttons covers the top
    return { x: (low[0] + high[0]) / 2, y: (low[1] + high[1]) / 2 + 22 / scale, scale };
  }
  const all = () => city.places.length
    ? fit([0, 1].map((k) => Math.min(...city.places.map((p) => p.low[k]))), [0, 1].map((k) => Math.max(...city.places.map((p) => p.high[k]))))
    : view;
  function fly(target) {
    const from = { ...view }, began = performance.now();
    const step = (now) => {
      const t = Math.min(1, Math.max(0, (now - began) / 320)), s = t * t * (3 - 2 * t);
      view.scale = from.scale * (target.scale / from.scale) ** s;
      const share = Math.abs(target.scale / from.scale - 1) < 1e-3 ? s : (1 / view.scale - 1 / from.scale) / (1 / target.scale - 1 / from.scale);
      view.x = from.x + (target.x - from.x) * share; view.y = from.y + (target.y - from.y) * share;
      paint();
      if (t < 1) requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }
  function showRow(row, moved = true) {
    state.row = row;
    document.querySelectorAll("tr.on").forEach((line) => line.classList.remove("on"));
    document.querySelectorAll(`tr[data-row="${row}"]`).forEach((line) => line.classList.add("on"));
    const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    for (let i = 0; i < map.n; i++) if (map.row[i] === row) for (const k of [0, 1]) {
      low[k] = Math.min(low[k], map.box[4 * i + k]); high[k] = Math.max(high[k], map.box[4 * i + 2 + k]);
    }
    if (moved && low[0] < Infinity) fly(fit(low, high)); else draw();
  }
  function showDoubt(number) {
    const doubt = city.doubts[number];
    state.at = number; state.doubts = true; state.row = -1;
    document.querySelectorAll(".doubts li").forEach((line, at) => line.classList.toggle("on", at === number));
    fly({ x: doubt.x, y: doubt.y, scale: Math.min(14, Math.max(4, width / (6 * doubt.length + 40))) });
  }

  function under(px, py) {
    const [x, y] = toSheet(px, py), reach = 7 / view.scale, points = map.points;
    let best = -1, least = reach * reach;
    for (let i = 0; i < map.n; i++) {
      const b = 4 * i;
      if (map.box[b] > x + reach || map.box[b + 2] < x - reach || map.box[b + 1] > y + reach || map.box[b + 3] < y - reach || !visible(i)) continue;
      for (let k = map.start[i]; k < map.start[i + 1] - 1; k++) {
        const ax = points[2 * k], ay = points[2 * k + 1], dx = points[2 * k + 2] - ax, dy = points[2 * k + 3] - ay;
        const t = Math.min(1, Math.max(0, ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1)));
        const d = (ax + t * dx - x) ** 2 + (ay + t * dy - y) ** 2;
        if (d < least) { least = d; best = i; }
      }
    }
    return best;
  }
  const tip = sheet.querySelector(".tip"), where = sheet.querySelector(".where");
  const escaped = (text) => text.replace(/[&<>"]/g, (letter) => `&#${letter.charCodeAt(0)};`);
  function tell(px, py) {
    const [x, y] = toSheet(px, py);
    const place = city.places.find((p) => x >= p.low[0] - 30 && x <= p.high[0] + 30 && y >= p.low[1] - 30 && y <= p.high[1] + 30);
    where.textContent = place && place.scale ? `${(place.origin[1] + (y - place.shift[1]) / place.scale[1]).toFixed(6)}, ${(place.origin[0] + (x - place.shift[0]) / place.scale[0]).toFixed(6)}` : "";
    const i = map.n < 4e5 ? under(px, py) : -1;
    tip.hidden = i < 0;
    if (i !== state.hover) { state.hover = i; draw(); }
    if (i < 0) return;
    const kind = city.kinds[map.kind[i] % 3].name, truth = map.kind[i] >= 3;
    const band = map.deviation[i] < 255 ? `, ± ${(map.deviation[i] * 0.02).toFixed(2)} m at most` : "";
    const facts = truth ? "ground truth" : `confidence ${(map.confidence[i] / 255).toFixed(2)}, seen in ${map.frames[i]} frames${band}`;
    tip.innerHTML = `<b>${kind}</b><br>${facts}<br><span>${escaped(city.rows[map.row[i]] || "")}</span>`;
    tip.style.left = `${Math.min(px + 14, width - 250)}px`; tip.style.top = `${py + 18 > height - 90 ? py - 84 : py + 18}px`;
  }

  const held = new Map();
  const local = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  function zoom(px, py, factor) {
    const [x, y] = toSheet(px, py);
    view.scale = Math.min(80, Math.max(0.002, view.scale * factor));
    view.x = x - (px - width / 2) / view.scale; view.y = y + (py - height / 2) / view.scale;
    draw();
  }
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(...local(event), Math.exp(-event.deltaY * 0.0016)); }, { passive: false });
  let pressed = null;
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); held.set(event.pointerId, local(event)); pressed = local(event); canvas.classList.add("held"); });
  canvas.addEventListener("pointermove", (event) => {
    const now = local(event), was = held.get(event.pointerId);
    if (!was) return tell(...now);
    tip.hidden = true;
    if (held.size === 2) {
      const other = [...held].find(([id]) => id !== event.pointerId)[1];
      zoom(...other, Math.hypot(now[0] - other[0], now[1] - other[1]) / Math.max(1, Math.hypot(was[0] - other[0], was[1] - other[1])));
    } else { view.x -= (now[0] - was[0]) / view.scale; view.y += (now[1] - was[1]) / view.scale; draw(); }
    held.set(event.pointerId, now);
  });
  const release = (event) => {
    held.delete(event.pointerId); canvas.classList.remove("held");
    if (event.type === "pointerup" && pressed && Math.hypot(local(event)[0] - pressed[0], local(event)[1] - pressed[1]) < 4) {
      const i = under(...pressed), near = city.doubts.findIndex((d) => { const [x, y] = toScreen(d.x, d.y); return Math.hypot(x - pressed[0], y - pressed[1]) < 10; });
      if (state.doubts && near >= 0) showDoubt(near); else showRow(i >= 0 && map.row[i] !== state.row ? map.row[i] : -1, false);
    }
  };
  canvas.addEventListener("pointerup", release); canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("pointerleave", () => { tip.hidden = true; state.hover = -1; draw(); });
  canvas.addEventListener("dblclick", (event) => zoom(...local(event), 2));
  canvas.addEventListener("keydown", (event) => {
    const pan = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (pan) { view.x += pan[0] * 80 / view.scale; view.y += pan[1] * 80 / view.scale; draw(); }
    else if (event.key === "+" || event.key === "-") zoom(width / 2, height / 2, event.key === "+" ? 1.5 : 1 / 1.5);
    else return;
    event.preventDefault();
  });
  for (const button of sheet.querySelectorAll("button")) button.addEventListener("click", () => {
    const { mode, kind, act } = button.dataset, press = (on) => button.setAttribute("aria-pressed", on);
    if (mode) { state.mode = mode; sheet.querySelectorAll("[data-mode]").forEach((b) => b.setAttribute("aria-pressed", b === button)); sheet.querySelector(".legend").hidden = mode === "kind"; }
    if (kind) press((state.shown[+kind] = !state.shown[+kind]));
    if (act === "doubts") press((state.doubts = !state.doubts));
    if (act === "truth") press((state.truth = !state.truth));
    if (act === "in" || act === "out") return zoom(width / 2, height / 2, act === "in" ? 1.6 : 1 / 1.6);
    if (act === "all") { state.at = null; showRow(-1, false); return fly(all()); }
    draw();
  });
  sheet.querySelector("select")?.addEventListener("change", (event) => {
    const place = city.places[+event.target.value];
    fly(place ? fit(place.low, place.high) : all());
  });
  sheet.querySelector(".ramp").style.background = `linear-gradient(90deg, ${[0, 0.25, 0.5, 0.75, 1].map(ramp)})`;
  document.querySelectorAll(".doubts li").forEach((line, number) => line.addEventListener("click", () => showDoubt(number)));
  document.addEventListener("click", (event) => { // the tables are still to come
    const line = event.target.closest("tr[data-row]");
    if (!line || event.target.closest("a")) return;
    sheet.scrollIntoView({ block: "nearest", behavior: "smooth" });
    showRow(+line.dataset.row);
  });
  let first = true;
  new ResizeObserver(() => {
    const ratio = window.devicePixelRatio || 1;
    [width, height] = [sheet.clientWidth, sheet.clientHeight];
    canvas.width = width * ratio; canvas.height = height * ratio;
    if (first) Object.assign(view, all());
    first = false;
    paint();
    document.body.dataset.drawn ??= performance.now();
  }).observe(sheet);
})();
