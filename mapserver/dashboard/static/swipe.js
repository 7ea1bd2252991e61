// Two versions of a map over each other: one left of a line, the other right of it, which a slider moves.
for (const swipe of document.querySelectorAll(".swipe"))
  swipe.addEventListener("input", ({ target }) => swipe.style.setProperty("--at", `${100 * target.value}%`));
