// Shows a page anew from time to time, as it would be loaded, unless somebody writes into it.
const EVERY_MS = 5000;
setInterval(async () => {
  const main = document.querySelector("main");
  if (document.hidden || main.contains(document.activeElement)) return;
  const answer = await fetch(location.href).catch(() => undefined);
  if (!answer?.ok) return;
  if (answer.redirected) location.reload(); // to sign in
  const fresh = new DOMParser().parseFromString(await answer.text(), "text/html").querySelector("main");
  if (fresh && fresh.innerHTML !== main.innerHTML) main.replaceChildren(...fresh.childNodes);
}, EVERY_MS);
