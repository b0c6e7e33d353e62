#!/bin/sh
# pack-vendor.sh SWAGGER_UI REDOC: take what /docs and /redoc need from two unpacked npm packages, compressed, with their
# licences; `make vendor` calls it. SHA256SUMS has the digests of what is inside.
set -eu
swagger=$1 redoc=$2
here=server/web/vendor
pack() { gzip -9nc "$1" > "$here/$2.gz"; }
pack "$swagger/swagger-ui-bundle.js" swagger-ui-bundle.js
pack "$swagger/swagger-ui.css" swagger-ui.css
pack "$redoc/bundles/redoc.standalone.js" redoc.standalone.js
{
    echo "Swagger UI $(node -p "require('$(realpath "$swagger")/package.json').version"), https://swagger.io"
    cat "$swagger/NOTICE" "$swagger/LICENSE" "$swagger/swagger-ui-bundle.js.LICENSE.txt"
} > "$here/LICENSE.swagger-ui.txt"
{
    echo "Redoc $(node -p "require('$(realpath "$redoc")/package.json').version"), https://redocly.com/redoc"
    cat "$redoc/LICENSE" "$redoc/bundles/redoc.standalone.js.LICENSE.txt"
} > "$here/LICENSE.redoc.txt"
cd "$here"
for each in *.gz; do
    printf '%s  %s\n' "$(gunzip -c "$each" | sha256sum | cut -d ' ' -f 1)" "${each%.gz}"
done > SHA256SUMS
