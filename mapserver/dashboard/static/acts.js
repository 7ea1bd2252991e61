// Acts: a button names a request to the HTTP API; a dialog explains it and asks for the reason and, without sign-in, the name.
// data-act: the address; data-body: more of the request's body, which a page may set; data-explains: what would change.
// A template, behind the button or of the id data-fields, has fields for more of the body, filled from the button's data.
// data-tells: the answer is shown in the dialog, where the page shows nothing of it; its words explain a secret or a file.
// data-each: a request for each row that is chosen in the table of the page; "*" in address and body is the row's.
// data-needs-reason: without a reason nothing is sent. data-lacks: set by a page while something is missing; the dialog then says that instead.
// Events: `asked` as the dialog opens, where a page may set `send` of the button to make another request; `acted` once it is done.
import { coded, refusal } from "./stream.js";

const dialog = document.createElement("dialog");
dialog.className = "ask-box";
dialog.innerHTML = `<form><h2></h2><p></p>
<fieldset><div></div>
<label class="name">Your name <input name="actor" maxlength="200" required pattern=".*\\S.*" autocomplete="name"></label>
<label>Reason (kept in the history) <input name="reason" maxlength="2000" pattern=".*\\S.*"></label></fieldset>
<output hidden></output>
<p class="notice bad" role="alert" hidden></p>
<div class="actions"><button class="plain confirm"></button> <button class="plain" type="button">No, change nothing</button></div></form>`;
document.body.append(dialog);
const form = dialog.querySelector("form");
const [title, explanation, notice, asks, fields, output] = ["h2", "p", ".notice", "fieldset", "fieldset > div", "output"].map((found) => form.querySelector(found));
const [confirm, refuse] = form.querySelectorAll("button");
const isNamed = document.body.dataset.named === "true";
let asked, rows;

function say(words, tone) {
  notice.replaceChildren(...coded(words));
  Object.assign(notice, { hidden: !words, className: `notice ${tone}` });
}

const chosenRows = () => [...document.querySelectorAll("tr:not([hidden]) [name=chosen]:checked")];

function post({ dataset }, told, row) {
  const given = (dataset.body || "{}").replace('"*"', row?.dataset.body ?? JSON.stringify(row?.value));
  const body = JSON.stringify({ ...JSON.parse(given), ...told });
  return fetch(dataset.act.replace("*", row?.value), { method: "POST", headers: { "Content-Type": "application/json" }, body });
}

document.addEventListener("click", ({ target }) => {
  const button = target.closest("[data-act]");
  if (!button) return;
  asked = button;
  const words = button.textContent.trim();
  const { each, needsReason } = button.dataset;
  rows = each === undefined ? [undefined] : chosenRows();
  const lacks = rows.length ? button.dataset.lacks : "Choose rows of the table first.";
  const names = each === undefined ? "" : `${rows.map(({ value }) => value).join(", ")}: `;
  title.textContent = `${words}?`;
  explanation.replaceChildren(...coded(lacks || `${names}${button.dataset.explains}`));
  confirm.textContent = `Yes: ${words}`;
  refuse.textContent = "No, change nothing";
  confirm.hidden = confirm.disabled = Boolean(lacks);
  const more = document.getElementById(button.dataset.fields) ?? button.nextElementSibling;
  fields.replaceChildren((!lacks && more?.content?.cloneNode(true)) || "");
  for (const field of fields.querySelectorAll("[name]")) field.value = button.dataset[field.name] ?? field.value;
  [asks.hidden, output.hidden] = [false, true];
  output.replaceChildren();
  form.reason.value = "";
  form.reason.required = needsReason !== undefined;
  form.actor.parentElement.hidden = form.actor.disabled = isNamed;
  say("", "bad");
  button.dispatchEvent(new Event("asked", { bubbles: true }));
  dialog.showModal();
});
refuse.addEventListener("click", () => dialog.close());
dialog.addEventListener("cancel", (event) => (refuse.disabled || !output.hidden) && event.preventDefault()); // an act that goes on, or its answer
dialog.addEventListener("close", () => output.hidden || location.reload());
form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const act = asked;
  const told = { ...given(), ...(isNamed ? {} : { actor: form.actor.value }), reason: form.reason.value };
  confirm.disabled = refuse.disabled = true;
  let answer;
  for (const row of rows) {
    answer = await (act.send ?? post)(act, told, row).catch(() => undefined);
    if (!answer?.ok) break;
    if (row) row.checked = false; // not again, where a later one is refused
    if (act.dataset.tells !== undefined) await tell(act, answer);
  }
  confirm.disabled = refuse.disabled = false;
  if (answer?.ok) {
    act.dispatchEvent(new Event("acted", { bubbles: true }));
    return act.dataset.tells === undefined && location.reload();
  }
  const why = await refusal(answer);
  if (asked !== act) return; // a browser may close the dialog all the same
  rows = rows.filter((row) => !row || row.checked);
  say(why, "bad");
});

function given() {
  const found = {};
  for (const { name, type, value, valueAsNumber, checked } of fields.querySelectorAll("[name]")) {
    if (type === "checkbox") found[name] = [...(found[name] ?? []), ...(checked ? [value] : [])];
    else found[name] = type === "number" ? valueAsNumber : value;
  }
  return found;
}

async function tell(act, answer) {
  const [, file] = answer.headers.get("Content-Disposition")?.match(/filename="(.+)"/) ?? [];
  const { detail, name, secret } = file ? { name: file } : await answer.json();
  say(detail ?? "", "good");
  [confirm.hidden, asks.hidden, output.hidden, refuse.textContent] = [true, true, !name, "Close"];
  if (name) [title.textContent, explanation.textContent] = [`${act.textContent.trim()}: ${name}`, act.dataset.tells];
  output.append(secret ?? "");
  if (file) {
    const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(await answer.blob()), download: file, textContent: file });
    output.append(link);
    link.click();
  }
  if (!dialog.open) dialog.showModal();
}
document.earlyAct?.click();
