// Not a module: it runs before the page is there. A click on an act is kept until acts.js is loaded.
document.addEventListener("click", ({ target }) => (document.earlyAct = target.closest("[data-act]")));
