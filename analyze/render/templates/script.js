"use strict";
(function () {
  document.documentElement.classList.add("js");
  const announcer = document.getElementById("announcer");

  // On paper nothing can be opened.
  window.addEventListener("beforeprint", function () {
    for (const folded of document.querySelectorAll("details")) folded.open = true;
  });

  // Tables: a button in every header; numbers sort as numbers, what has no value stays last in both directions.
  function compare(a, b) {
    const x = Number(a), y = Number(b);
    return Number.isNaN(x) || Number.isNaN(y) ? a.localeCompare(b, "en", { numeric: true }) : x - y;
  }
  function sort(table, column, header) {
    const ascending = header.getAttribute("aria-sort") !== "ascending";
    const body = table.tBodies[0];
    const key = (row) => row.cells[column].dataset.key;
    const rows = Array.from(body.rows);
    rows.sort(function (a, b) {
      const x = key(a), y = key(b);
      if (x === "" || y === "") return (x === "") - (y === "");
      return ascending ? compare(x, y) : compare(y, x);
    });
    body.append(...rows);
    for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
    header.setAttribute("aria-sort", ascending ? "ascending" : "descending");
    announcer.textContent = "Sorted by " + header.textContent + ", " + header.getAttribute("aria-sort") + ".";
  }
  for (const table of document.querySelectorAll("table.sortable")) {
    Array.from(table.tHead.rows[0].cells).forEach(function (header, column) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = header.textContent;
      button.title = "Sort by this column";
      button.addEventListener("click", () => sort(table, column, header));
      header.replaceChildren(button);
    });
  }
})();
