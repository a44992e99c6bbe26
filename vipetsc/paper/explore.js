// Pictures from which numbers can be read: the page shows the values of the point nearest to the pointer, enlarges a
// picture by a click, and draws its curves again, with a zoom and without those that are switched off. The numbers of
// each picture are those of vipetsc.figures.figure_data.
"use strict";

const SVG = "http://www.w3.org/2000/svg", WIDTH = 720, HEIGHT = 400, LEFT = 64, RIGHT = 12, TOP = 10, BOTTOM = 42;

function make(name, attributes = {}, parent = null, text = "") {
  const element = name.startsWith("svg:") ? document.createElementNS(SVG, name.slice(4)) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text) element.textContent = text;
  if (parent) parent.append(element);
  return element;
}

const number = v => (v !== 0 && (Math.abs(v) < 1e-3 || Math.abs(v) >= 1e5)) ? v.toExponential(3) : String(+v.toPrecision(4));
// Where a value lies on an axis, as a fraction of its length (0 to 1), the value at such a fraction, and a point in words.
const fraction = (axis, v) => axis.log ? Math.log(v / axis.low) / Math.log(axis.high / axis.low) : (v - axis.low) / (axis.high - axis.low);
const value = (axis, s) => axis.log ? axis.low * (axis.high / axis.low) ** s : axis.low + s * (axis.high - axis.low);
const describe = (axes, x, y) => `${axes.x.label || "x"}: ${number(x)}; ${axes.y.label || "y"}: ${number(y)}`;

// The point of the curves that is nearest to a place, both as fractions of the axes; null if no point lies within these.
// Distances are in the units of width and height.
function nearest(axes, curves, sx, sy, width, height) {
  let best = null, reach = Infinity;
  for (const curve of curves) curve.x.forEach((x, i) => {
    if (x === null || curve.y[i] === null) return;
    const px = fraction(axes.x, x), py = fraction(axes.y, curve.y[i]);
    const distance = Math.hypot((px - sx) * width, (py - sy) * height);
    if (distance < reach && px >= 0 && px <= 1 && py >= 0 && py <= 1) { reach = distance; best = {curve, x, y: curve.y[i], px, py}; }
  });
  return best;
}

// The value of a map at a place of its picture, in fractions of this, from the colour there; "" if the colour is farther
// than FAR (of 255) from all colours of the map.
const pixel = make("canvas", {width: 1, height: 1}).getContext("2d", {willReadFrequently: true}), FAR = 40;

function read(map, image, fx, fy) {
  const [x, y] = [fx * image.naturalWidth, fy * image.naturalHeight].map(Math.floor);
  pixel.drawImage(image, x, y, 1, 1, 0, 0, 1, 1);
  const seen = pixel.getImageData(0, 0, 1, 1).data, stops = map.colours.match(/../g).map(two => parseInt(two, 16));
  let at = -1, least = FAR;
  for (let i = 0; i + 1 < map.values.length; i++) {
    let along = 0, length = 0, distance = 0;
    for (let c = 0; c < 3; c++) {
      const step = stops[3 * i + 3 + c] - stops[3 * i + c];
      along += (seen[c] - stops[3 * i + c]) * step;
      length += step * step;
    }
    const t = Math.min(Math.max(along / (length || 1), 0), 1);
    for (let c = 0; c < 3; c++) distance += (seen[c] - (1 - t) * stops[3 * i + c] - t * stops[3 * i + 3 + c]) ** 2;
    if (Math.sqrt(distance) < least) { least = Math.sqrt(distance); at = i + t; }
  }
  if (at < 0) return "";
  const i = Math.min(Math.floor(at), map.values.length - 2), last = map.values.length - 1;
  const v = map.values[i] + (at - i) * (map.values[i + 1] - map.values[i]);
  return `; ${map.label || "value"} ${at < 0.3 ? "≤" : at > last - 0.3 ? "≥" : "≈"} ${Number(v.toPrecision(2))}`;
}

function ticks(axis, most) {
  const low = Math.min(axis.low, axis.high), high = Math.max(axis.low, axis.high), found = [];
  if (axis.log && high / low > 20) {
    const decades = Math.log10(high / low), every = Math.ceil(decades / most);
    for (let e = Math.ceil(Math.log10(low) - 1e-9); e <= Math.log10(high) + 1e-9; e += every) found.push(10 ** e);
    return found;
  }
  const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find(m => m * power >= rough);
  for (let v = Math.ceil(low / step) * step; v <= high + 1e-9 * step; v += step) found.push(Math.abs(v) < 1e-9 * step ? 0 : v);
  return found;
}

// Draws the curves of one axes into `host`: dragging zooms, a double click or a button shows the whole range again, and
// the name of a curve switches it off.
function plot(axes, host) {
  const whole = {x: {...axes.x}, y: {...axes.y}}, shown = {...axes, ...whole}, off = new Set();
  const place = make("div", {class: "plot"}, host), legend = make("div", {class: "legend"}, place);
  const svg = make("svg:svg", {viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": axes.title || "curves"}, place);
  const readout = make("output", {class: "small"}, place), w = WIDTH - LEFT - RIGHT, h = HEIGHT - TOP - BOTTOM;
  let begin = null, frame = null;

  function draw() {
    svg.replaceChildren();
    const clip = make("svg:svg", {x: LEFT, y: TOP, width: w, height: h, viewBox: `0 0 ${w} ${h}`, overflow: "hidden"});
    for (const v of ticks(shown.x, 7)) {
      const x = LEFT + fraction(shown.x, v) * w;
      make("svg:line", {x1: x, x2: x, y1: TOP, y2: TOP + h, class: "grid"}, svg);
      make("svg:text", {x, y: TOP + h + 16, "text-anchor": "middle"}, svg, number(v));
    }
    for (const v of ticks(shown.y, 6)) {
      const y = TOP + (1 - fraction(shown.y, v)) * h;
      make("svg:line", {x1: LEFT, x2: LEFT + w, y1: y, y2: y, class: "grid"}, svg);
      make("svg:text", {x: LEFT - 6, y: y + 4, "text-anchor": "end"}, svg, number(v));
    }
    make("svg:rect", {x: LEFT, y: TOP, width: w, height: h, class: "edge"}, svg);
    make("svg:text", {x: LEFT + w / 2, y: HEIGHT - 6, "text-anchor": "middle"}, svg, axes.x.label);
    make("svg:text", {x: -TOP - h / 2, y: 13, transform: "rotate(-90)", "text-anchor": "middle"}, svg, axes.y.label);
    svg.append(clip);
    for (const curve of axes.curves) if (!off.has(curve)) {
      let path = "", pen = "M";
      curve.x.forEach((x, i) => {
        const px = fraction(shown.x, x) * w, py = (1 - fraction(shown.y, curve.y[i])) * h;
        if (x === null || curve.y[i] === null || !isFinite(px) || !isFinite(py)) { pen = "M"; return; }
        if (curve.joined) { path += `${pen}${px.toFixed(1)} ${py.toFixed(1)}`; pen = "L"; }
        if (!curve.joined || curve.x.length < 80) make("svg:circle", {cx: px, cy: py, r: 2.5, fill: curve.colour}, clip);
      });
      if (path) make("svg:path", {d: path, stroke: curve.colour, class: "curve"}, clip);
    }
    frame = make("svg:rect", {class: "frame", width: 0, height: 0}, svg);
  }
  const at = event => {
    const box = svg.getBoundingClientRect();
    const x = (event.clientX - box.left) * WIDTH / box.width - LEFT, y = (event.clientY - box.top) * HEIGHT / box.height - TOP;
    return [Math.min(Math.max(x / w, 0), 1), Math.min(Math.max(1 - y / h, 0), 1)];
  };
  const reset = () => { Object.assign(shown, {x: whole.x, y: whole.y}); draw(); };
  const named = new Map();
  for (const curve of axes.curves) {
    const name = curve.label || "others";
    named.set(name, [...named.get(name) || [], curve]);
  }
  for (const [name, curves] of named) {
    const button = make("button", {type: "button", "aria-pressed": "true", style: `border-left-color: ${curves[0].colour}`}, legend, name);
    button.onclick = () => {
      const on = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", on);
      for (const curve of curves) if (on) off.delete(curve); else off.add(curve);
      draw();
    };
  }
  make("button", {type: "button", class: "reset"}, legend, "whole range").onclick = svg.ondblclick = reset;
  svg.onpointerdown = event => { begin = at(event); svg.setPointerCapture(event.pointerId); };
  svg.onpointermove = event => {
    const [sx, sy] = at(event);
    const best = nearest(shown, axes.curves.filter(c => !off.has(c)), sx, sy, w, h);
    readout.textContent = best ? `${best.curve.label} ${describe(axes, best.x, best.y)}` : describe(axes, value(shown.x, sx), value(shown.y, sy));
    if (begin) for (const [key, v] of Object.entries({
      x: LEFT + Math.min(begin[0], sx) * w, y: TOP + (1 - Math.max(begin[1], sy)) * h,
      width: Math.abs(begin[0] - sx) * w, height: Math.abs(begin[1] - sy) * h})) frame.setAttribute(key, v);
  };
  svg.onpointerup = event => {
    const from = begin, to = at(event);
    begin = null;
    if (!from || Math.abs(from[0] - to[0]) < 0.02 || Math.abs(from[1] - to[1]) < 0.02) { if (frame) frame.setAttribute("width", 0); return; }
    ["x", "y"].forEach((key, i) => {
      const [a, b] = [from[i], to[i]].sort((p, q) => p - q);
      shown[key] = {...shown[key], low: value(shown[key], a), high: value(shown[key], b)};
    });
    draw();
  };
  svg.onpointercancel = () => { begin = null; };
  draw();
}

// The numbers of a picture, which the page holds compressed by zlib.
async function unpacked(source) {
  const bytes = Uint8Array.from(atob(source.textContent), letter => letter.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).json();
}

// Names of all axes, no two of them equal: the title, and what is drawn over what.
function names(all) {
  const full = all.map(({title, x, y}) => [title, [y.label, x.label].filter(Boolean).join(" over ")].filter(Boolean).join(": "));
  return full.map((name, i) => name && full.indexOf(name) === full.lastIndexOf(name) ? name : `${name || "panel"} (${i + 1})`);
}

// Shows a picture on the whole screen, where a finger moves it; a tap, the button or Escape closes it.
const viewer = document.querySelector("dialog");

function show(image, fx, fy) {
  // In front of the button in the document: behind it, the picture would cover the button.
  const large = viewer.querySelector("img") || viewer.insertBefore(make("img"), viewer.firstChild), width = Math.max(2.5 * viewer.ownerDocument.documentElement.clientWidth, image.naturalWidth);
  large.src = image.src;
  large.alt = image.alt;
  large.style.width = `${width}px`;
  viewer.showModal();
  viewer.scrollTo(fx * width - viewer.clientWidth / 2, fy * large.clientHeight - viewer.clientHeight / 2);
}
if (viewer) viewer.onclick = () => viewer.close();

async function explore(figure) {
  const source = figure.querySelector("script"), holder = figure.querySelector(".frame"), image = figure.querySelector("img");
  if (!source || !holder) return;
  const all = await unpacked(source), readout = make("output", {class: "small"}), tools = make("div", {class: "tools"});
  const mark = make("span", {class: "mark", hidden: ""}, holder);
  figure.querySelector("figcaption").before(readout);
  readout.after(tools);
  image.onpointerdown = image.onpointermove = event => {
    const box = image.getBoundingClientRect(), fx = (event.clientX - box.left) / box.width, fy = (event.clientY - box.top) / box.height;
    const axes = all.filter(({box: [l, t, r, b]}) => fx >= l && fx <= r && fy >= t && fy <= b).pop();
    mark.hidden = true;
    if (!axes) { readout.textContent = ""; return; }
    const [l, t, r, b] = axes.box, sx = (fx - l) / (r - l), sy = (b - fy) / (b - t);
    const best = nearest(axes, axes.curves, sx, sy, (r - l) * box.width, (b - t) * box.height);
    readout.textContent = best ? `${best.curve.label} ${describe(axes, best.x, best.y)}` : describe(axes, value(axes.x, sx), value(axes.y, sy));
    if (axes.map) readout.textContent += read(axes.map, image, fx, fy);
    if (best) {
      mark.style.left = `${(l + best.px * (r - l)) * image.offsetWidth}px`;
      mark.style.top = `${(b - best.py * (b - t)) * image.offsetHeight}px`;
      mark.hidden = false; // shown last: at its old place below the picture it would bring a scroll bar
    }
  };
  image.onpointerleave = () => { mark.hidden = true; };
  image.onclick = event => {
    const fx = event.offsetX / image.offsetWidth, fy = event.offsetY / image.offsetHeight;
    if (event.pointerType === "touch") { show(image, fx, fy); return; }
    const large = holder.classList.toggle("large");
    if (large) holder.scrollTo(fx * image.offsetWidth - holder.clientWidth / 2, fy * image.offsetHeight - holder.clientHeight / 2);
  };
  const curves = all.filter(axes => axes.curves.length);
  if (!curves.length) return;
  const choice = make("select", {"aria-label": "curves to draw larger"}, tools);
  make("option", {value: -1}, choice, "curves, larger …");
  names(curves).forEach((name, i) => make("option", {value: i}, choice, name));
  choice.onchange = () => {
    figure.querySelectorAll(".plot").forEach(other => other.remove());
    if (choice.value >= 0) plot(curves[choice.value], tools);
  };
}

document.querySelectorAll("figure").forEach(explore);
// On a narrow screen the contents are folded.
const contents = document.querySelector("nav details");
if (contents) contents.open = matchMedia("(min-width: 70rem)").matches;
