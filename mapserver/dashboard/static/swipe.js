// Two versions of a map over each other: one left of a line, the other right of it, which a slider moves.
for (const swipe of document.querySelectorAll(".swipe")) {
  const [left, right, line] = swipe.querySelectorAll("rect");
  const { x, width } = swipe.querySelector("svg").viewBox.baseVal;
  const slider = swipe.querySelector("input");
  slider.addEventListener("input", () => {
    const at = x + width * slider.value;
    left.setAttribute("width", at - x);
    for (const part of [right, line]) part.setAttribute("x", at);
  });
}
