// The forms of a day in the diary: a place or a leg of its picture opens the forms that correct its row.

const here = (id) => document.getElementById(id);
const rows = [...document.querySelectorAll("tr[data-start]")];

// A point of the screen in the pixels of a map, however it is enlarged.
const pointAt = (ground, x, y) => new DOMPoint(x, y).matrixTransform(ground.querySelector(".pins").getScreenCTM().inverse());

// Longitude and latitude [deg] of a point of the screen on a map: three corners of the map have shares of Mercator's.
const lonlatAt = (ground, x, y) => {
  const at = pointAt(ground, x, y);
  const [width, height] = [ground.width.baseVal.value, ground.height.baseVal.value];
  const corners = ground.dataset.shares.split(" ").map(Number);
  const [east, south] = [0, 1].map(
    (n) =>
      corners[n] + (at.x / width) * (corners[n + 2] - corners[n]) + (at.y / height) * (corners[n + 4] - corners[n]),
  );
  return [(east - 0.5) * 360, (Math.atan(Math.sinh((0.5 - south) * 2 * Math.PI)) * 180) / Math.PI];
};

// Show the forms of a row. link: of the picture; number: of the row.
const open = async (link, number) => {
  const address = new URL(link.getAttribute("href"), location.href);
  address.searchParams.set("n", number);
  const answer = await fetch(address);
  const page = new DOMParser().parseFromString(await answer.text(), "text/html");
  const title = Object.assign(document.createElement("h2"), { textContent: page.querySelector("h1").textContent, tabIndex: -1 });
  const others = link.dataset.n.split(" ").filter((other) => other !== String(number)).map((other) => {
    const times = [...rows[other].cells].slice(0, 2).map((cell) => cell.innerText);
    const button = Object.assign(document.createElement("button"), { type: "button", textContent: times.join("–") });
    button.addEventListener("click", () => open(link, other));
    return button;
  });
  const forms = [...page.querySelectorAll("form, .fault")];
  here("forms").replaceChildren(title, ...others, ...forms);
  here("forms").hidden = false;
  document.querySelectorAll(".moving").forEach((other) => other.classList.remove("moving"));
  title.focus();
  const moved = forms.find((form) => form.elements?.do?.value === "at");
  if (!moved || !link.matches(".dot") || !link.closest("[data-shares]")) return;
  moved.append(Object.assign(document.createElement("small"), { textContent: " or drag the stay on the map" }));
  link.classList.add("moving");
};

// Drag the place whose forms are open.
const drag = (link) => {
  const ground = link.closest(".ground"), mark = link.closest("g[transform]");
  let held = false, dragged = false;
  link.addEventListener("pointerdown", (event) => {
    dragged = false;
    held = link.matches(".moving");
    if (held) link.setPointerCapture(event.pointerId);
  });
  link.addEventListener("pointermove", (event) => {
    if (!held || !event.buttons) return;
    dragged = true;
    const at = pointAt(ground, event.clientX, event.clientY);
    mark.setAttribute("transform", `translate(${at.x} ${at.y})`);
  });
  link.addEventListener("pointerup", (event) => {
    held = false;
    if (!dragged) return;
    const [lon, lat] = lonlatAt(ground, event.clientX, event.clientY);
    const moved = [...here("forms").querySelectorAll("form")].find((form) => form.elements.do.value === "at");
    moved.elements.value.value = `${lat.toFixed(6)},${lon.toFixed(6)}`;
    moved.querySelector("button").focus();
  });
  return () => dragged;
};

document.querySelectorAll("svg a.entry").forEach((link) => {
  const wasDragged = link.matches(".dot") ? drag(link) : () => false;
  link.addEventListener("click", (event) => {
    if (event.ctrlKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    if (!wasDragged()) open(link, link.dataset.n.split(" ")[0]);
  });
});
document.documentElement.dataset.ready = "yes";
