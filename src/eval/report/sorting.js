// Makes the headings of tables buttons that sort. "absent" stays at the end either way.
for (const table of document.querySelectorAll("table.sortable")) {
  const body = table.tBodies[0];
  const text = (row, column) => row.cells[column].textContent.trim();
  const number = (t) => parseFloat(t.replace(/,/g, "").replace("−", "-"));
  [...table.tHead.rows[0].cells].forEach((heading, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...heading.childNodes);
    heading.append(button);
    button.addEventListener("click", () => {
      const rows = [...body.rows];
      const numeric = rows.some((row) => row.cells[column].classList.contains("number"));
      const from = heading.getAttribute("aria-sort");
      // Numbers begin with the largest, names with A.
      const ascending = from ? from === "descending" : !numeric;
      for (const other of heading.parentNode.cells) other.removeAttribute("aria-sort");
      heading.setAttribute("aria-sort", ascending ? "ascending" : "descending");
      const compare = (a, b) => {
        const [s, t] = [text(a, column), text(b, column)];
        const [x, y] = [number(s), number(t)];
        if (numeric && (isNaN(x) || isNaN(y))) return isNaN(x) - isNaN(y);
        const order = numeric ? x - y : s.localeCompare(t, "en", { numeric: true });
        return ascending ? order : -order;
      };
      body.append(...rows.sort(compare));
    });
  });
}
