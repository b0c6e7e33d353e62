/* global SwaggerUIBundle */
import { key } from "./access.js";
import { description } from "./interface.js";

const ui = SwaggerUIBundle({
  spec: await description(),
  dom_id: "#interface",
  deepLinking: true,
  validatorUrl: null, // it would be asked over the network
  // What is tried out goes with the key that the description came by.
  onComplete: () => key() !== null && ui.preauthorizeApiKey("key", key()),
});
