// Tables that sort by a click on a heading, and a field that finds rows. Most rows come when the browser is idle.
const complete = (table) => {
  const rest = table.parentElement.querySelector("template");
  if (rest) { table.tBodies[0].append(rest.content); rest.remove(); }
};
for (const table of document.querySelectorAll("table.sortable")) {
  const body = table.tBodies[0];
  const heads = [...table.tHead.rows[0].cells];
  const value = (row, column) => {
    const cell = row.cells[column];
    if (!cell || cell.dataset.value === "") return null;
    return cell.dataset.value !== undefined ? +cell.dataset.value : cell.textContent.trim();
  };
  const sort = (column, down) => {
    complete(table);
    const rows = [...body.rows].map((row) => [value(row, column), row]);
    rows.sort(([a], [b]) => {
      if (a === null || b === null) return (a === null) - (b === null); // what is not known stays at the end
      const order = typeof a === "number" ? a - b : a.localeCompare(b, undefined, { numeric: true });
      return down ? -order : order;
    });
    body.append(...rows.map(([, row]) => row));
    heads.forEach((head) => head.removeAttribute("aria-sort"));
    heads[column].setAttribute("aria-sort", down ? "descending" : "ascending");
  };
  heads.forEach((head, column) => {
    head.addEventListener("click", () => {
      const was = head.getAttribute("aria-sort");
      sort(column, was ? was === "ascending" : !head.classList.contains("text"));
    });
  });
}
for (const field of document.querySelectorAll("input.find")) {
  const table = document.getElementById(field.dataset.table);
  field.addEventListener("input", () => {
    complete(table);
    const wanted = field.value.toLowerCase();
    for (const row of table.tBodies[0].rows) row.hidden = !row.textContent.toLowerCase().includes(wanted);
  });
}
(window.requestIdleCallback || setTimeout)(() => {
  document.querySelectorAll("table.sortable").forEach(complete);
  document.body.dataset.complete = performance.now();
});
