// Verdict, headline, warnings and tables.

const element = (tag, text, more = {}) =>
  Object.assign(document.createElement(tag), text === undefined ? more : { textContent: text, ...more });
const judge = ({ state, reasons }) => {
  const list = element("ul");
  list.append(...reasons.map((reason) => element("li", `${reason.text} (to check: ${reason.check})`)));
  here("verdict").className = state;
  const lacks = content.missing.length ? `, but ${content.missing.length} missing, see below` : "";
  here("verdict").append(element("strong", state), reasons.length ? list : `: no reason for doubt found${lacks}`);
  if (lacks && !reasons.length) here("verdict").className = "doubtful";
};
const write = () => {
  if (content.verdict) judge(content.verdict);
  document.title = `${content.title} – pdr_graph`;
  here("title").textContent = content.title;
  here("subtitle").textContent = content.subtitle;
  for (const [what, much] of content.headline) {
    const pair = element("div");
    pair.append(element("dt", what), element("dd", much));
    here("headline").append(pair);
  }
  for (const [lines, kind, name] of [
    [content.missing, "missing", "Missing"],
    [content.warnings, "warnings", "Warnings"],
    [content.notes || [], "notes", "Notes"],
  ]) {
    const list = element("ul"),
      notice = element("details", undefined, { className: kind, open: kind !== "notes" });
    list.append(...lines.map((line) => element("li", line)));
    notice.append(element("summary", `${name} (${lines.length})`), list);
    if (lines.length) here("notices").append(notice);
  }
  if (content.maps.length > 1)
    content.maps.forEach((own, n) =>
      here("chooser").append(element("button", own.name || "all", { type: "button", onclick: () => choose(n) })),
    );
};
const NUMBER = /^[-+−]?[\d.,:]+\s?(%|Hz|m|s|min|h \d\d min)?$/;
const cells = (table) => {
  const body = element("table"),
    head = element("tr"),
    inside = element("div", undefined, { className: "scroll", tabIndex: 0 });
  const numeric = (k) => table.rows.length && table.rows.every((row) => !row[k] || NUMBER.test(row[k]));
  head.append(
    ...table.head.map((name, k) => element("th", name, { scope: "col", className: numeric(k) ? "number" : "" })),
  );
  body.append(element("thead"), element("tbody"));
  body.tHead.append(head);
  table.rows.forEach((row, n) => {
    const line = element("tr");
    row.forEach((text, k) => {
      const cell = element("td", undefined, { className: NUMBER.test(text) ? "number" : "" });
      cell.append(
        k === 0 && table.moments.length
          ? element("button", text, { type: "button", onclick: () => jump(table.moments[n]) })
          : text,
      );
      line.append(cell);
    });
    body.tBodies[0].append(line);
  });
  inside.append(body);
  return [...(table.note ? [element("p", table.note, { className: "note" })] : []), inside];
};
const tabulate = () =>
  content.tables.forEach((table) => {
    const details = element("details");
    details.append(element("summary", table.rows.length > 5 ? `${table.title} (${table.rows.length})` : table.title));
    const filled = () => {
      if (details.children.length < 2) details.append(...cells(table));
      const inside = details.querySelector(".scroll");
      inside.classList.toggle("wider", inside.scrollWidth > inside.clientWidth + 1);
    };
    details.addEventListener("toggle", filled);
    details.open = table.open;
    here("tables").append(details);
  });
