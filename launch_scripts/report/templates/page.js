"use strict";
// Sort a table by the column whose heading is pressed; numbers first from the largest.
for (const button of document.querySelectorAll("thead button")) {
  button.addEventListener("click", () => {
    const th = button.parentElement, table = th.closest("table"), body = table.tBodies[0], at = th.cellIndex;
    const value = row => row.cells[at].dataset.by ?? row.cells[at].textContent;
    const down = th.getAttribute("aria-sort") ? th.getAttribute("aria-sort") === "ascending" : at > 0;
    const sign = down ? -1 : 1;
    const rows = [...body.rows].sort((a, b) => {
      const x = value(a), y = value(b);
      if (x === "" || y === "") return (x === "") - (y === "");
      const both = Number(x) - Number(y);
      return sign * (Number.isNaN(both) ? x.localeCompare(y, undefined, {numeric: true}) : both);
    });
    for (const other of table.querySelectorAll("th")) other.removeAttribute("aria-sort");
    th.setAttribute("aria-sort", down ? "descending" : "ascending");
    body.append(...rows);
  });
}
// A vehicle that is pressed, on the map or in the table, stands out in both.
const map = document.querySelector(".map");
const prefix = "vehicle:";
for (const group of document.querySelectorAll(`.layers [id^="${prefix}"]`)) {
  group.dataset.vehicle = group.id.slice(prefix.length);
  group.classList.add("vehicle");
  const hit = group.querySelector("path").cloneNode();  // wider than what is seen, to be pressed
  hit.setAttribute("style", "");
  hit.classList.add("hit");
  group.append(hit);
}
for (const group of document.querySelectorAll('.layers [id^="vehicle:"], .layers [id^="target:"]')) {
  const title = document.createElementNS("http://www.w3.org/2000/svg", "title");
  title.textContent = group.id.split(":")[1];
  group.prepend(title);
}
const vehicles = [...document.querySelectorAll("[data-vehicle]")];
let picked = null;
function pick(id) {
  picked = picked === id ? null : id;
  for (const each of vehicles) each.classList.toggle("picked", each.dataset.vehicle === picked);
  if (map) map.classList.toggle("picking", picked !== null);
}
for (const each of vehicles) each.addEventListener("click", () => pick(each.dataset.vehicle));
for (const box of document.querySelectorAll("[data-layer]")) {
  box.addEventListener("change", () => {
    for (const layer of document.querySelectorAll(box.dataset.layer)) layer.style.display = box.checked ? "" : "none";
  });
}
