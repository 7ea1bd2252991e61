// Follows what the server says every second, until the session ends.
export function follow(path, take, fail = () => {}) {
  const stream = new EventSource(`${path}?site=${encodeURIComponent(document.querySelector("header select[name=site]").value)}`);
  stream.onmessage = ({ data }) => take(JSON.parse(data));
  stream.onerror = fail;
  stream.addEventListener("ended", ({ data }) => location.assign(data));
}
