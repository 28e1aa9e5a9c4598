"use strict";
// Enlarges the maps of a page, and moves the walker of a day along its tracks.

const all = (selector, within = document) => [...within.querySelectorAll(selector)];
const element = (name, attributes, text = "") =>
  Object.assign(document.createElement(name), attributes, { textContent: text });
const lengthText = (metres) => (metres < 1000 ? `${metres} m` : `${metres / 1000} km`);
// The longest of 1, 2, 5, 10 … that is not above a length.
const roundLength = (most) => {
  const power = 10 ** Math.floor(Math.log10(most));
  return +(power * [5, 2, 1].find((times) => times * power <= most)).toPrecision(1);
};

// Place the labels of a map beside their marks where they overlap nothing and are whole; hide the others.
const SIDES = [[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, 1], [1, -1], [-1, -1]];
const overlap = (one, other) => one[0] < other[2] && other[0] < one[2] && one[1] < other[3] && other[1] < one[3];
const placeLabels = (ground, [left, top, width, height], size) => {
  const [right, bottom] = [left + width, top + height];
  const pins = all(".pins > g", ground).reverse().map((pin) => {
    const { e: x, f: y } = pin.transform.baseVal[0].matrix, radius = pin.querySelector("circle")?.r.baseVal.value ?? 2;
    return { x, y, radius, text: pin.querySelector("text") };
  });
  const [high, wide] = [44, 80].map((length) => (length * width) / ground.width.baseVal.value);
  const occupied = pins.map(({ x, y, radius: r }) => [x - r * size, y - r * size, x + r * size, y + r * size]);
  occupied.push([right - high, top, right, top + high], [right - wide, bottom - high, right, bottom]); // north, buttons
  const scales = ground.parentNode.querySelector(".heat-scale") ? 0.8 : 1 / 3; // of the bar, and of a heat map
  occupied.push([left, bottom - high / 2, left + width * scales, bottom]);
  pins.forEach(({ x, y, radius, text }) => {
    const { width: long, height: tall } = text.getBBox();
    const middles = SIDES.map(([a, b]) => [a * (radius + 3 + long / 2), b * (radius + 1 + tall / 2)]);
    const boxes = middles.map(([a, b]) => [a - long / 2, b - tall / 2, a + long / 2, b + tall / 2]);
    const placed = boxes.map(([a, b, c, d]) => [x + a * size, y + b * size, x + c * size, y + d * size]);
    const free = placed.findIndex(
      (box) =>
        box[0] >= left && box[1] >= top && box[2] <= right && box[3] <= bottom && !occupied.some((o) => overlap(o, box)),
    );
    text.style.visibility = free < 0 ? "hidden" : "visible";
    if (free < 0) return;
    text.setAttribute("x", middles[free][0]);
    text.setAttribute("y", middles[free][1] + 0.32 * tall);
    occupied.push(placed[free]);
  });
};

// Maps: buttons, and the wheel with Ctrl, enlarge; an enlarged map is dragged.
const CLOSEST = 1 / 256; // of the width of a map
all("figure.map").forEach((figure) => {
  const ground = figure.querySelector(".ground"),
    outer = figure.querySelector("svg"),
    bar = figure.querySelector(".scale-bar");
  const { width, height } = ground.viewBox.baseVal;
  let [left, top, share, pin] = [0, 0, 1, 1]; // of what is shown: corner [px], share of the width; size of letters
  const show = () => {
    left = Math.min(Math.max(left, 0), width * (1 - share));
    top = Math.min(Math.max(top, 0), height * (1 - share));
    ground.setAttribute("viewBox", [left, top, width * share, height * share].join(" "));
    figure.style.setProperty("--share", share);
    figure.classList.toggle("enlarged", share < 1);
    const metres = ground.dataset.metres * share; // of a pixel of the figure
    const length = roundLength((metres * width) / 5);
    bar.querySelector("path").setAttribute("d", `M0,0h${length / metres}`);
    bar.querySelector("text").setAttribute("x", length / metres + 6);
    bar.querySelector("text").textContent = lengthText(length);
    placeLabels(ground, [left, top, width * share, height * share], share * pin);
  };
  const pixel = (event) => {
    const box = outer.getBoundingClientRect();
    return [((event.clientX - box.left) / box.width) * width, ((event.clientY - box.top) / box.height) * height];
  };
  const enlarge = (by, [x, y] = [width / 2, height / 2]) => {
    const before = share;
    share = Math.min(1, Math.max(CLOSEST, share / by));
    left += x * (before - share);
    top += y * (before - share);
    show();
  };
  new ResizeObserver(() => {
    // on a phone a map is small, and its letters are not
    pin = Math.min(2, Math.max(1, (0.8 * width) / outer.clientWidth));
    figure.style.setProperty("--pin", pin);
    show();
  }).observe(outer);
  const buttons = element("div", { className: "zoom" });
  [["+", "enlarge", 2], ["−", "reduce", 0.5]].forEach(([text, title, by]) => {
    const button = element("button", { type: "button", title }, text);
    button.addEventListener("click", () => enlarge(by));
    buttons.append(button);
  });
  figure.append(buttons);
  outer.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return; // the page is scrolled
    event.preventDefault();
    enlarge(event.deltaY < 0 ? 1.25 : 0.8, pixel(event));
  }, { passive: false });
  let held = null;
  outer.addEventListener("pointerdown", (event) => {
    held = share < 1 && !event.target.closest(".moving") ? pixel(event) : null;
  });
  outer.addEventListener("pointermove", (event) => {
    if (!held || !event.buttons) return;
    const now = pixel(event);
    left -= (now[0] - held[0]) * share;
    top -= (now[1] - held[1]) * share;
    held = now;
    show();
  });
  outer.addEventListener("dragstart", (event) => event.preventDefault());
});

// The walker: where it was at a time on each map.
const SPEED = 600; // of the clock while playing
const slider = document.getElementById("slider");
const rows = all("tr[data-start]");
const tracks = all("[data-track]").map((ground) => {
  const walker = document.createElementNS("http://www.w3.org/2000/svg", "g");
  walker.innerHTML = '<circle class="pin walker" r="6"></circle>';
  ground.append(walker);
  const parts = ground.dataset.track.split(";").map((part) => part.split(",").map((row) => row.split(" ").map(Number)));
  return { walker, parts };
});

const placeAt = (parts, time) => {
  const part = parts.find((rows) => rows[0][0] <= time && time <= rows.at(-1)[0]);
  if (!part) return null;
  const next = Math.max(part.findIndex((row) => row[0] >= time), 1);
  const [before, after] = [part[next - 1], part[next] ?? part[0]];
  const along = after[0] > before[0] ? (time - before[0]) / (after[0] - before[0]) : 0;
  return before.map((value, n) => value + along * (after[n] - value));
};

const show = (time) => {
  slider.value = time;
  let sigma = 0;
  tracks.forEach(({ walker, parts }) => {
    const place = placeAt(parts, time);
    walker.style.display = place ? "" : "none";
    if (!place) return;
    walker.setAttribute("transform", `translate(${place[1]} ${place[2]})`);
    sigma = place[3];
  });
  const now = rows.find((row) => time < +row.dataset.end) ?? rows.at(-1);
  rows.forEach((row) => row.classList.toggle("now", row === now));
  const clock = new Date(Math.floor(time + +now.dataset.offset) * 1000).toISOString().slice(11, 19);
  const [, , , what, , where] = [...now.cells].map((cell) => cell.innerText);
  const around = sigma ? `± ${sigma.toFixed(sigma < 10 ? 1 : 0)} m` : "";
  document.getElementById("clock").textContent = [clock, what, where, around].filter(Boolean).join("   ");
};

if (slider && rows.length) {
  document.getElementById("player").hidden = false;
  const button = document.getElementById("play");
  let playing = null;
  const step = (begin, since) => (now) => {
    const time = begin + ((now - since) / 1000) * SPEED;
    show(Math.min(time, +slider.max));
    playing = time < +slider.max ? requestAnimationFrame(step(begin, since)) : null;
    button.textContent = playing ? "❚❚" : "▶";
  };
  button.addEventListener("click", () => {
    const begin = +slider.value < +slider.max ? +slider.value : +slider.min;
    if (playing) cancelAnimationFrame(playing);
    playing = playing ? null : requestAnimationFrame(step(begin, performance.now()));
    button.textContent = playing ? "❚❚" : "▶";
  });
  slider.addEventListener("input", () => show(+slider.value));
  rows.forEach((row) => row.addEventListener("click", () => show(+row.dataset.start)));
  show(+slider.value);
}
