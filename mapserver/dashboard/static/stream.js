// What the server says while a page is open. None of it is a use of the session, which ends an hour after somebody did something.
const AGAIN_MS = 5000;

// The page as it would be loaded now; without a body where it is that of `tag` still, nothing where nobody answers.
export const loaded = (tag = "") => fetch(location.href, { headers: { "Fleetmap-Renewal": "1", "If-None-Match": tag } }).catch(() => undefined);
export const isSignedOut = (answer) => answer?.redirected || answer?.status === 401;

// Follows what the server says every second, until the session ends. Hidden pages do not: a browser has six connections for all of them.
export function follow(path, take, fail = () => {}) {
  const asked = new URLSearchParams(location.search);
  asked.set("site", document.querySelector("header select[name=site]").value);
  let stream;
  function open() {
    stream?.close();
    if (document.hidden) return;
    stream = new EventSource(`${path}?${asked}`);
    stream.onmessage = ({ data }) => take(JSON.parse(data));
    stream.addEventListener("ended", ({ data }) => location.assign(data));
    stream.onerror = async ({ target }) => {
      fail();
      // Browsers try again but where the stream was refused, as by a proxy while the server restarts.
      if (target.readyState !== EventSource.CLOSED) return;
      if (isSignedOut(await loaded())) return location.reload();
      setTimeout(open, AGAIN_MS);
    };
  }
  document.addEventListener("visibilitychange", open);
  open();
}
