// What the server says while a page is open. None of it is a use of the session, which ends an hour after somebody did something.
const AGAIN_MS = 5000;

// What the page is asked with, always of the site that it shows: without one the server chooses, and perhaps another one than before.
function asked() {
  const found = new URLSearchParams(location.search), site = document.querySelector("header select[name=site]").value;
  if (site) found.set("site", site);
  return found;
}
const silent = {}; // whether the server does not answer, by what was asked for: the page, or a stream
function answers(source, isSo) {
  silent[source] = !isSo;
  document.getElementById("silent").hidden = !Object.values(silent).includes(true);
}

// Words of the server as nodes: what is to be typed stands between `.
export const coded = (words) =>
  words.split(/`([^`]+)`/).map((part, n) => (n % 2 ? Object.assign(document.createElement("code"), { textContent: part }) : part));

// Why a request was refused, in words.
export async function refusal(answer, otherwise = "The server does not answer; try again.") {
  return (await answer?.json().catch(() => undefined))?.detail ?? otherwise;
}

// The page as it would be loaded now; without a body where it is that of `tag` still, nothing where nobody answers.
export async function loaded(tag = "") {
  const headers = { "Fleetmap-Renewal": "1", "If-None-Match": tag };
  const answer = await fetch(`?${asked()}`, { headers }).catch(() => undefined);
  answers("page", answer?.status < 400);
  return answer;
}
export const isSignedOut = (answer) => answer?.redirected || [401, 403].includes(answer?.status);

// Follows what the server says every second, until the session ends. Hidden pages do not: a browser has six connections for all of them.
export function follow(path, take) {
  let stream;
  function open() {
    stream?.close();
    if (document.hidden) return;
    stream = new EventSource(`${path}?${asked()}`);
    stream.onopen = () => answers(path, true);
    stream.onmessage = ({ data }) => take(JSON.parse(data));
    stream.addEventListener("ended", ({ data }) => location.assign(data));
    stream.onerror = async ({ target }) => {
      answers(path, false);
      // Browsers try again but where the stream was refused, as by a proxy while the server restarts.
      if (target.readyState !== EventSource.CLOSED) return;
      if (isSignedOut(await loaded())) return location.reload();
      setTimeout(open, AGAIN_MS);
    };
  }
  document.addEventListener("visibilitychange", open);
  open();
}
