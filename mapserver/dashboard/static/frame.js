// What every page does: the viewer's time zone, another theme, another site.
const remember = (name, value) => (document.cookie = `${name}=${value};path=/;max-age=31536000;samesite=strict`);
remember("fleetmap_zone", Intl.DateTimeFormat().resolvedOptions().timeZone);
document.getElementById("theme").addEventListener("change", ({ target }) => {
  remember("fleetmap_look", target.value);
  const themes = { dark: "body--dark", light: "" };
  document.body.className = `console ${themes[target.value] ?? "print"}`;
});
for (const kind of ["click", "keydown"])
  document.addEventListener(kind, ({ target, key }) => {
    const range = document.querySelector(".range[open]");
    if (!range || (key ? key !== "Escape" : range.contains(target))) return;
    if (key && range.contains(target)) range.firstElementChild.focus();
    range.open = false;
  });
document.querySelector("header select[name=site]").addEventListener("change", ({ target }) => target.form.submit());
