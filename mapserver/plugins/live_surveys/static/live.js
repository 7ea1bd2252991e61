// The live page is shown anew as soon as more of the survey was heard; at first it has no map.
import "../../static/map/index.js";
import { renew } from "../../static/renew.js";
import { follow } from "../../static/stream.js";

follow("live/now", ({ heard }) => (heard && !document.getElementById("map") ? location.reload() : renew()));
