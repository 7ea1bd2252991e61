// The live page is shown anew as soon as more of the survey was heard; at first it has no map.
import "./maps.js";
import { renew } from "./renew.js";
import { follow } from "./stream.js";

follow("live/now", ({ heard }) => (heard && !document.getElementById("map") ? location.reload() : renew()));
