// Acts: a button names a request to the HTTP API; a dialog explains it and asks for the reason and, without sign-in, the name.
// data-act: the address; data-body: more of the request's body, which a page may set; data-explains: what would change.
// data-tells: the answer is shown in the dialog, where the page shows nothing of it.
// data-needs-reason: without a reason nothing is sent. data-lacks: set by a page while something is missing; the dialog then says that instead.
// data-fields: the template of further fields, filled from the button's data and sent with the body. Events: `asked` as the dialog
// opens, where a page may set `send` of the button to make another request; `acted` once it is done.
const dialog = document.createElement("dialog");
dialog.className = "ask-box";
dialog.innerHTML = `<form><h2></h2><p></p><div></div>
<label class="name">Your name <input name="actor" maxlength="200" required pattern=".*\\S.*" autocomplete="name"></label>
<label>Reason (kept in the history) <input name="reason" maxlength="2000" pattern=".*\\S.*"></label>
<p class="notice bad" role="alert" hidden></p>
<div class="actions"><button class="plain confirm"></button> <button class="plain" type="button">No, change nothing</button></div></form>`;
document.body.append(dialog);
const form = dialog.querySelector("form");
const [title, explanation, fields, notice] = ["h2", "p", "div", ".notice"].map((found) => form.querySelector(found));
const [confirm, refuse] = form.querySelectorAll("button");
const isNamed = document.body.dataset.named === "true";
let asked;

function post({ dataset }, told) {
  const body = JSON.stringify({ ...JSON.parse(dataset.body || "{}"), ...told });
  return fetch(dataset.act, { method: "POST", headers: { "Content-Type": "application/json" }, body });
}

const say = (words, tone) => ((notice.textContent = words), (notice.hidden = !words), (notice.className = `notice ${tone}`));

document.addEventListener("click", ({ target }) => {
  const button = target.closest("[data-act]");
  if (!button) return;
  asked = button;
  const words = button.textContent.trim();
  const { lacks, needsReason } = button.dataset;
  [title.textContent, explanation.textContent] = [`${words}?`, lacks || button.dataset.explains];
  confirm.textContent = `Yes: ${words}`;
  confirm.hidden = confirm.disabled = Boolean(lacks);
  refuse.textContent = "No, change nothing";
  form.reason.value = "";
  form.reason.required = needsReason !== undefined;
  form.actor.parentElement.hidden = form.actor.disabled = isNamed;
  const more = !lacks && document.getElementById(button.dataset.fields)?.content.cloneNode(true);
  fields.replaceChildren(...(more ? [more] : []));
  for (const field of fields.querySelectorAll("input, select")) field.value = button.dataset[field.name] ?? "";
  say("", "bad");
  button.dispatchEvent(new Event("asked", { bubbles: true }));
  dialog.showModal();
});
refuse.addEventListener("click", () => dialog.close());
dialog.addEventListener("cancel", (event) => refuse.disabled && event.preventDefault()); // an act that goes on
form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const act = asked;
  const told = Object.fromEntries(new FormData(form));
  confirm.disabled = refuse.disabled = true;
  const answer = await (act.send ?? post)(act, told).catch(() => undefined);
  confirm.disabled = refuse.disabled = false;
  if (answer?.ok) act.dispatchEvent(new Event("acted", { bubbles: true }));
  const tells = answer?.ok && act.dataset.tells !== undefined;
  if (answer?.ok && !tells) return location.reload();
  const found = await answer?.json().catch(() => undefined);
  if (asked !== act) return; // a browser may close the dialog all the same
  say(found?.detail ?? "The server does not answer; try again.", tells ? "good" : "bad");
  if (!tells) return;
  confirm.hidden = true;
  refuse.textContent = "Close";
});
