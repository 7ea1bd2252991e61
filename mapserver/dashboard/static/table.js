// Lists in which people work. A table is sorted by a click on a column's name, and what is shown of it is saved as CSV; what is typed into
// the page's search hides the rows of tables and lists that lack it. The address keeps what is searched, the session how tables are sorted.
const LISTS = ".scroll > table > tbody, .rows, #robots";
const search = document.getElementById("search");
const collator = new Intl.Collator(undefined, { numeric: true });
const orderOf = (table) => JSON.parse(sessionStorage.getItem(`${location.pathname} ${table.ariaLabel}`) ?? "{}");
const words = (cell) => cell.textContent.trim().replace(/\s+/g, " ");
const UNITS = { min: 60, h: 3600, days: 86400, kB: 1e3, MB: 1e6, GB: 1e9, TB: 1e12 };
const made = (tag, given) => Object.assign(document.createElement(tag), given);

// What begins with a number is sorted by it and its unit, and stands before words.
function number(text) {
  const [, digits, unit] = /^([+-]?[\d.]+) ?([a-z]*)/i.exec(text) ?? [];
  return digits === undefined ? Infinity : digits * (UNITS[unit] ?? 1);
}
const compare = (a, b) => number(a) - number(b) || collator.compare(a, b);

// Finds, sorts and names what a page lists; also of one that is loaded anew, before it is shown.
export function arrange(root) {
  const wanted = search?.value.toLowerCase() ?? "";
  for (const list of root.querySelectorAll(LISTS))
    for (const row of list.children) row.hidden = !row.textContent.toLowerCase().includes(wanted);
  for (const table of root.querySelectorAll(".scroll > table")) arrangeTable(table);
}

function arrangeTable(table) {
  const [heads, rows] = [[...table.tHead.rows[0].cells], [...table.tBodies[0].rows].filter(({ cells }) => !cells[0].matches("[colspan]"))];
  const { title, isDown } = orderOf(table);
  const column = heads.findIndex((head) => words(head) === title);
  for (const [n, head] of heads.entries()) {
    if (n === column) head.ariaSort = isDown ? "descending" : "ascending";
    else head.removeAttribute("aria-sort");
    if (!head.children.length) head.replaceChildren(made("button", { type: "button", textContent: head.textContent }));
    for (const { cells } of rows) cells[n].dataset.name = words(head);
  }
  if (column >= 0) table.tBodies[0].append(...rows.sort((a, b) => compare(words(a.cells[column]), words(b.cells[column])) * (isDown ? -1 : 1)));
  const bar = table.nextElementSibling ?? table.parentElement.appendChild(made("p", { className: "quiet" }));
  bar.innerHTML = '<span></span> <button type="button" class="plain" data-csv>Save as CSV</button>';
  bar.firstChild.textContent = `${rows.filter(({ hidden }) => !hidden).length} of ${rows.length}`;
}

function sortBy(head) {
  const table = head.closest("table");
  const order = { title: words(head), isDown: head.ariaSort === "ascending" };
  sessionStorage.setItem(`${location.pathname} ${table.ariaLabel}`, JSON.stringify(order));
  arrangeTable(table);
}

// A file says when, and not how long ago.
function exact(cell) {
  const copy = cell.cloneNode(true);
  for (const time of copy.querySelectorAll("time")) time.textContent = time.title;
  return words(copy);
}

// Robots and people choose their words: none begins a formula of a spreadsheet.
const field = (text) => `"${/^[=@]|^[+-](?![\d.]+[ %°a-z/]{0,6}$)/.test(text) ? "'" : ""}${text.replaceAll('"', '""')}"`;

function save(table) {
  const rows = [...table.rows].filter(({ hidden }) => !hidden);
  const lines = rows.map(({ cells }) => [...cells].filter((cell) => !cell.matches(".choose")).map((cell) => field(exact(cell))).join(","));
  const href = URL.createObjectURL(new Blob([`${lines.join("\r\n")}\r\n`], { type: "text/csv" }));
  made("a", { href, download: `${table.ariaLabel}.csv` }).click();
}

document.addEventListener("click", ({ target }) => {
  if (target.matches("th > button")) sortBy(target.parentElement);
  if (target.matches("[data-csv]")) save(target.closest(".scroll").firstElementChild);
});
document.addEventListener("change", ({ target }) => {
  if (!target.matches("[data-all]")) return;
  for (const box of target.closest("table").querySelectorAll("tr:not([hidden]) [name=chosen]")) box.checked = target.checked;
});
search?.addEventListener("input", () => {
  const found = (address) => {
    const to = new URL(address);
    if (search.value) to.searchParams.set("find", search.value);
    else to.searchParams.delete("find");
    return to;
  };
  history.replaceState(history.state, "", found(location));
  for (const link of document.querySelectorAll(".choices a")) link.href = found(link.href);
  arrange(document);
});
arrange(document);
