// Recordings are uploaded one after another, and the log of a job is followed while it is open.
import { renew } from "./renew.js";
import { coded, refusal } from "./stream.js";

const LOG_MS = 5000;
const [drop, form, list, log] = ["drop", "upload", "uploads", "log"].map((id) => document.getElementById(id));
let isUploading = false;

// Why a file is not in the inbox, in words; empty once it is.
async function put(file, query, row) {
  const request = new XMLHttpRequest();
  const [bar, stop] = ["progress", "button"].map((part) => row.querySelector(part));
  request.upload.onprogress = ({ loaded, total }) => ([bar.max, bar.value] = [total, loaded]);
  stop.onclick = () => request.abort();
  const ended = new Promise((resolve) => (request.onloadend = request.onabort = resolve));
  request.open("PUT", `${form.dataset.to}/${encodeURIComponent(file.name)}?${query}`);
  request.send(file);
  if ((await ended).type === "abort") return "Stopped; nothing was kept.";
  if (!request.status) return "The connection broke, nothing was kept; upload it again.";
  const unknown = `The server refused it (${request.status}).`; // or a proxy before it did
  return request.status === 201 ? "" : refusal(new Response(request.response), unknown);
}

async function upload(files, query) {
  isUploading = true;
  const rows = files.map(({ name }) => {
    const row = document.createElement("li");
    row.className = "quiet";
    row.innerHTML = '<strong></strong> <progress value="0" max="1"></progress> <button type="button" class="plain">Stop</button>';
    row.firstChild.textContent = name;
    row.querySelector("progress").ariaLabel = `Upload of ${name}`;
    row.querySelector("button").onclick = () => row.remove();
    return row;
  });
  list.append(...rows);
  for (const [n, row] of rows.entries()) {
    if (!row.isConnected) continue;
    const why = await put(files[n], query, row);
    row.replaceChildren(row.firstChild, " ", ...coded(why));
    row.className = "bad";
    if (!why) row.remove();
    await renew();
  }
  isUploading = false;
}

if (form) {
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const { files, actor, reason } = form.elements;
    const given = { ...(actor && { actor: actor.value }), ...(reason.value && { reason: reason.value }) };
    upload([...files.files], new URLSearchParams(given));
    files.value = "";
  });
  for (const kind of ["dragover", "drop"]) drop.addEventListener(kind, (event) => event.preventDefault());
  drop.addEventListener("drop", ({ dataTransfer }) => {
    drop.open = true;
    form.elements.files.files = dataTransfer.files;
  });
  addEventListener("beforeunload", (event) => isUploading && event.preventDefault());
}

if (log) {
  const state = () => document.querySelector(`#jobs [data-job="${log.dataset.job}"]`)?.dataset.state;
  const before = state();
  const follow = async () => {
    if (before === "running" && state() !== "running" && !isUploading) return location.reload(); // its recordings are known now
    if (!log.open || document.hidden) return;
    const answer = await fetch(log.dataset.log, { headers: { "Fleetmap-Renewal": "1" } }).catch(() => undefined);
    const text = answer?.ok ? await answer.text() : await refusal(answer);
    const shown = log.querySelector("pre");
    const isAtEnd = shown.scrollTop + shown.clientHeight > shown.scrollHeight - 40;
    if (shown.textContent === text) return;
    shown.textContent = text;
    if (isAtEnd) shown.scrollTop = shown.scrollHeight;
  };
  log.addEventListener("toggle", follow);
  setInterval(follow, LOG_MS);
}
