// Makes parts of the page like those of another one. What is the same stays: focus, what somebody opened, a row under the pointer.
import { arrange } from "./table.js";

function morph(node, other) {
  const isTemplate = node.nodeName === "TEMPLATE"; // what is in it is compared by nobody
  if (node.isEqualNode(other) && !isTemplate) return;
  if (node.nodeName !== other.nodeName || node.nodeType !== Node.ELEMENT_NODE || isTemplate) return node.replaceWith(other);
  for (const { name } of [...node.attributes]) if (!other.hasAttribute(name) && name !== "open") node.removeAttribute(name);
  for (const { name, value } of other.attributes) if (name !== "open" && node.getAttribute(name) !== value) node.setAttribute(name, value);
  morphChildren(node, other);
}

function morphChildren(node, other) {
  const ids = new Set([...other.children].map(({ id }) => id));
  for (const child of [...node.children]) if (child.id && !ids.has(child.id)) child.remove();
  const known = new Map([...node.children].map((child) => [child.id, child]));
  let at = node.firstChild;
  for (const fresh of [...other.childNodes]) {
    const own = fresh.id ? known.get(fresh.id) : at?.id ? null : at;
    if (own && own === at) at = at.nextSibling;
    else (own && node.moveBefore ? node.moveBefore : node.insertBefore).call(node, own ?? fresh, at); // moveBefore keeps the focus
    if (own) morph(own, fresh);
  }
  while (at) {
    const next = at.nextSibling;
    at.remove();
    at = next;
  }
}

// Parts of the page become what those of their ids are in `fresh`. False where one stays as it is, since somebody writes into it.
export function renewParts(fresh, parts) {
  arrange(fresh);
  const isWritten = (part) => part.contains(document.activeElement) && document.activeElement.matches("input:not([type=checkbox]), select, textarea");
  for (const part of parts) {
    const other = fresh.getElementById(part.id);
    if (other && !isWritten(part)) morph(part, other);
  }
  return !parts.some(isWritten);
}
