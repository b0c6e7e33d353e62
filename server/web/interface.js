// The description of the HTTP interface, for the pages that show it.

import { getJson } from "./access.js";

/** The OpenAPI document. Where there is none, the page says why. */
export async function description() {
  try {
    return await getJson("openapi.json", { needed: true });
  } catch (error) {
    document.getElementById("interface").textContent = error.message;
    throw error;
  }
}
