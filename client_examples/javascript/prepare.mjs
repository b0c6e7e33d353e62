// Puts the package's modules into src/: those that the server's own page is built on. `npm install` and `npm pack` run it.

import { cpSync, existsSync, rmSync } from "node:fs";
import { fileURLToPath } from "node:url";

const here = (path) => fileURLToPath(new URL(path, import.meta.url));
const modules = here("../../server/web/nafir");
if (existsSync(modules)) {
  rmSync(here("src"), { recursive: true, force: true });
  cpSync(modules, here("src"), { recursive: true });
  cpSync(here("../../LICENSE"), here("LICENSE"));
}
