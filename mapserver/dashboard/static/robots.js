// The list of robots: what is typed is kept in the address, and the list follows.
import { renew } from "./renew.js";

document.getElementById("search").addEventListener("input", ({ target: { value } }) => {
  const to = new URL(location);
  if (value) to.searchParams.set("find", value);
  else to.searchParams.delete("find");
  history.replaceState(null, "", to);
  renew();
});
