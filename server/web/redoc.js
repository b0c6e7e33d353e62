/* global Redoc */
import { description } from "./interface.js";

Redoc.init(await description(), {}, document.getElementById("interface"));
