"use strict";
// Tables of images and pairs: sorted by their headers, searched, and shown by the hundred.
const PAGE_ROWS = 100;

class DataTable {
  // columns: [{title, value(row), text(row), kind: "number" | "name" | "word" | "reason", cell(row)}]
  constructor(host, { label, kind, rows, columns, sort, descending }) {
    Object.assign(this, { kind, rows, columns, sort, descending, words: "", limit: PAGE_ROWS });
    const tools = element("div", "", { class: "tools" });
    const search = element("label", `Search ${label} `);
    const input = element("input", "", { type: "search", placeholder: "name, verdict or reason" });
    input.addEventListener("input", () => { this.words = input.value.toLowerCase(); this.limit = PAGE_ROWS; this.fill(); });
    search.append(input);
    this.found = element("span", "", { class: "quiet", role: "status" });
    tools.append(search, this.found);
    const table = element("table", "", { class: "data", "aria-label": label });
    const head = element("tr");
    this.headers = columns.map((column, k) => this.header(column, k));
    head.append(...this.headers);
    const thead = element("thead");
    thead.append(head);
    this.body = element("tbody");
    table.append(thead, this.body);
    const scroll = element("div", "", { class: "scroll tall" });
    scroll.append(table);
    this.more = element("button", `Show ${PAGE_ROWS} more`, { type: "button" });
    this.more.addEventListener("click", () => { this.limit += PAGE_ROWS; this.fill(); });
    host.append(tools, scroll, this.more);
    this.fill();
    selection.listeners.push((chosen, from) => this.mark(chosen, from));
  }

  header(column, k) {
    const cell = element("th", "", { scope: "col", class: column.kind || "" });
    if (!column.value) {
      cell.textContent = column.title;
      return cell;
    }
    const button = element("button", column.title, { type: "button" });
    button.addEventListener("click", () => {
      this.descending = this.sort === k ? !this.descending : column.kind === "number";
      this.sort = k;
      this.fill();
    });
    cell.append(button);
    return cell;
  }

  text(row) {
    return this.columns.map((column) => (column.text ? column.text(row) : "")).join(" ").toLowerCase();
  }

  // Rows that match the search, sorted; unknown values come last in both directions.
  ordered() {
    const value = this.columns[this.sort].value, sign = this.descending ? -1 : 1;
    const found = this.words ? this.rows.filter((row) => this.text(row).includes(this.words)) : [...this.rows];
    return found.sort((one, other) => {
      const [a, b] = [value(one), value(other)];
      if (a === null || b === null) return (a === null) - (b === null);
      return sign * (typeof a === "number" ? a - b : a.localeCompare(b, "en", { numeric: true })) || one - other;
    });
  }

  fill() {
    const rows = this.ordered();
    this.headers.forEach((cell, k) => {
      if (k === this.sort) cell.setAttribute("aria-sort", this.descending ? "descending" : "ascending");
      else cell.removeAttribute("aria-sort");
    });
    this.body.replaceChildren(...rows.slice(0, this.limit).map((row) => this.line(row)));
    this.found.textContent = `${rows.length.toLocaleString("en")} of ${this.rows.length.toLocaleString("en")}`;
    this.more.hidden = rows.length <= this.limit;
  }

  line(row) {
    const line = element("tr", "", { tabindex: "0", "data-row": row });
    line.setAttribute("aria-selected", String(selection.current[this.kind] === row));
    for (const column of this.columns) {
      const cell = element("td", "", { class: column.kind || "" });
      if (column.cell) column.cell(row, cell);
      else cell.textContent = column.text(row);
      line.append(cell);
    }
    const choose = () => select({ [this.kind]: row }, "table");
    line.addEventListener("click", choose);
    line.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      choose();
    });
    return line;
  }

  mark(chosen, from) {
    for (const line of this.body.children) {
      line.setAttribute("aria-selected", String(Number(line.dataset.row) === chosen[this.kind]));
    }
    if (from === "table" && chosen[this.kind] !== undefined) byId("view").scrollIntoView({ block: "start" });
  }
}

function verdictCell(word, color) {
  return (row, cell) => {
    const dot = element("span", "", { class: "dot" });
    dot.style.background = color(word(row));
    cell.append(dot, word(row));
  };
}

function imageColor(word) {
  return `var(--${word === "registered" ? "good" : word === "other_model" ? "warn" : "bad"})`;
}

function numberColumn(title, values, shown = (value) => value.toLocaleString("en")) {
  return { title, kind: "number", value: (row) => values[row], text: (row) => values[row] === null ? "" : shown(values[row]) };
}

function nameColumn(title, row) {
  return { title, kind: "name", value: (k) => imageName(row(k)), text: (k) => imageName(row(k)) };
}

function makeTables() {
  const photographs = images.photograph.some(Boolean), sigmas = images.position_sigma.some((value) => value !== null);
  const picture = (row, cell) => {
    if (images.photograph[row]) cell.append(element("img", "", { src: images.photograph[row], alt: "", loading: "lazy" }));
  };
  new DataTable(byId("images-table"), {
    label: "images", kind: "image", rows: images.name.map((_, row) => row), sort: photographs ? 1 : 0, descending: false,
    columns: [
      ...(photographs ? [{ title: "", cell: picture }] : []),
      nameColumn("Image", (row) => row),
      { title: "Model", value: (row) => images.model[row] || null, text: (row) => images.model[row] },
      { title: "Verdict", kind: "word", value: (row) => images.verdict[row], text: (row) => images.verdict[row],
        cell: verdictCell((row) => images.verdict[row], imageColor) },
      numberColumn("Pairs kept", images.kept), numberColumn("Pairs", images.pairs),
      ...(sigmas ? [numberColumn("σ position, %", images.position_sigma, (value) => value.toFixed(2)),
        numberColumn("σ rotation", images.rotation_sigma, degrees)] : []),
      { title: "Why", kind: "reason", text: imageReason },
    ],
  });
  new DataTable(byId("pairs-table"), {
    label: "pairs", kind: "pair", rows: pairs.a.map((_, pair) => pair), sort: 4, descending: true,
    columns: [
      nameColumn("Image 1", (k) => pairs.a[k]), nameColumn("Image 2", (k) => pairs.b[k]),
      { title: "Verdict", kind: "word", value: (k) => pairs.verdict[k], text: (k) => pairs.verdict[k],
        cell: verdictCell((k) => pairs.verdict[k], verdictColor) },
      numberColumn("Inliers", pairs.inliers), numberColumn("Rotation error", pairs.rotation, degrees),
      numberColumn("Direction error", pairs.direction, degrees),
      numberColumn("σ", pairs.sigmas, (value) => value.toFixed(1)),
      { title: "Why", kind: "reason", text: pairReason },
    ],
  });
}
