#!/usr/bin/env bash
# Builds the container image and tries it as an operator would, where no Docker engine runs.
#
#   sudo apt-get install buildah podman runc netavark mmdebstrap curl podman-compose caddy prometheus
#   sudo make container-test
#
# The Dockerfile is built unmodified by buildah with `--isolation chroot`. Its base image is made here by mmdebstrap:
# Debian with its Python 3.13 (the 3.11 of the release before is too old for requirements.lock), in an image store of this
# script's own, which is deleted at the end. podman and runc then run the image with a read-only root; the script waits
# for /readyz, looks at the page, GETs an impulse response and checks that it is a stereo wav with sound in it, and walks
# through the scene over WebSocket. In the house it asks for a response with a door shut and open, and opens that door in a
# stream. Then podman-compose runs deploy/compose.yaml in its own networks, on ports 80 and 443: behind Caddy an outsider gets
# nothing but /livez, a key made meanwhile opens the server, Prometheus reads its metrics, and a client listens through wss.
# Meanwhile every query of the dashboard is put to Prometheus: by Grafana, as its provisioning has set it up, where there is
# one. Neither start compiles anything.
#
# Environment, all optional:
#   PORT=8000            port on the host's loopback, where the image is tried alone
#   SCENE=apartment      scene to ask for
#   QUERY=...            query of the impulse-response request
#   CONTEXT=.            folder with the Dockerfile
#   STATE=FOLDER         keep the image store and the base system here and use them again next time
#   BASE_IMAGE=python:3.13-slim   DEBIAN_SUITE=trixie   DEBIAN_MIRROR=URL
#   PULL_BASE=1          take BASE_IMAGE and those that compose.yaml names from their registries
#   GRAFANA=FOLDER       a Grafana for Linux (bin/, conf/, public/, packaging/docker/run.sh), where its image cannot be had
#   BUILD_MOUNTS="/a /b" host folders that pip needs during the build (local wheels, say), mounted read-only
#   CA_BUNDLE=FILE       certificates for the build; the host's own by default
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
context=${CONTEXT:-$root}
base=${BASE_IMAGE:-python:3.13-slim}
image=nafir:container-test
container=nafir-container-test
listener=$container-listener
port=${PORT:-8000}
scene=${SCENE:-apartment}
query=${QUERY:-listener=1,2,1.5&emitter=6,3,1.5&yaw_deg=90}
house_query='listener=2,3,1.6&emitter=6,2,1.5' # on both sides of this door
house_door=living
url=http://127.0.0.1:$port

say() { printf '\n== %s\n' "$*"; }
fail() { printf 'container test failed: %s\n' "$*" >&2; exit 1; }

for program in buildah podman podman-compose runc curl python3; do
    command -v "$program" >/dev/null || fail "$program is not installed"
done
[ "$(id -u)" -eq 0 ] || fail "run it as root: the base system and the image store are made as root"

! curl --silent --output /dev/null "$url" || fail "port $port is taken"

keep=${STATE:+yes}
state=${STATE:-$(mktemp -d)}
mkdir -p "$state"
state=$(cd "$state" && pwd)
store=(--root "$state/images" --runroot "$state/run")
run_podman() { podman "${store[@]}" --runtime "$(command -v runc)" --cgroup-manager cgroupfs "$@"; }

composed=
ulimits=(--ulimit nofile=1024:1024 --ulimit nproc=4096:4096)
unpack='import sys, tarfile; tarfile.open(fileobj=sys.stdin.buffer, mode="r|").extractall("/dev/shm", filter="data")'
tear_down() {
    if [ -n "$composed" ]; then
        run_compose down --volumes || true
        run_podman network rm --force nafir-test_front nafir-test_proxied nafir-test_inside >/dev/null 2>&1 || true
    fi
    run_podman rm --force --ignore "$container" "$listener" >/dev/null 2>&1 || true
    if [ -z "$keep" ]; then
        run_podman rmi --all --force >/dev/null 2>&1 || true
        rm -rf "$state"
    fi
}
trap tear_down EXIT

if [ -n "${PULL_BASE:-}" ]; then
    say "pulling $base"
    buildah "${store[@]}" pull "$base"
elif ! run_podman image exists "localhost/$base"; then
    say "making $base"
    if [ ! -f "$state/base.tar" ]; then
        command -v mmdebstrap >/dev/null || fail "mmdebstrap is not installed"
        mmdebstrap --quiet --format=tar --variant=minbase \
            --include=ca-certificates,python-is-python3,python3,python3-pip,python3-venv \
            "${DEBIAN_SUITE:-trixie}" "$state/base.tar.part" ${DEBIAN_MIRROR:+"$DEBIAN_MIRROR"}
        mv "$state/base.tar.part" "$state/base.tar"
    fi
    run_podman import --quiet "$state/base.tar" "localhost/$base"
fi

mounts=()
mount_file() { [ ! -f "$1" ] || mounts+=(--volume "$1:$2:ro"); }
mount_file "${CA_BUNDLE:-/etc/ssl/certs/ca-certificates.crt}" /etc/ssl/certs/ca-certificates.crt
mount_file /etc/pip.conf /etc/pip.conf
mount_file "${PIP_CONFIG_FILE:-${XDG_CONFIG_HOME:-$HOME/.config}/pip/pip.conf}" /root/.config/pip/pip.conf
for folder in ${BUILD_MOUNTS:-}; do
    mounts+=(--volume "$folder:$folder:ro")
done

say "building $image"
started=$SECONDS
# Docker's image format: the OCI one has no HEALTHCHECK.
buildah "${store[@]}" bud --isolation chroot --format docker --pull-never --layers "${mounts[@]}" \
    --build-arg "BASE=$base" --tag "$image" "$context"
echo "built in $((SECONDS - started)) s"
run_podman images --filter "reference=$image"
bytes=$(run_podman image inspect "$image" --format '{{.Size}}')
((bytes <= 350000000)) || fail "the image has $((bytes / 1000000)) MB, more than 350"

say "looking into it"
run_podman image inspect "$image" --format 'user {{.User}}, exposes {{.Config.ExposedPorts}}, command {{.Config.Entrypoint}} {{.Config.Cmd}}'
case $(run_podman image inspect "$image" --format '{{.User}}') in
    "" | 0 | 0:* | root | root:*) fail "the image runs as root" ;;
esac
[ "$(run_podman image inspect "$image" --format '{{if .HealthCheck}}yes{{end}}')" = yes ] || fail "the image has no health check"

# The health check is run below: podman would have systemd time it.
start_server() {
    started=$SECONDS
    run_podman run --detach --name "$container" --no-healthcheck --network host --read-only --read-only-tmpfs=false \
        --cap-drop all --security-opt no-new-privileges \
        "${ulimits[@]}" \
        --env NAFIR_HOST=127.0.0.1 --env "NAFIR_PORT=$port" --env NAFIR_MAX_CONNECTIONS=512 "$@" "$image" >/dev/null
    until curl --silent --fail --output /dev/null "$url/readyz"; do
        [ "$(run_podman inspect "$container" --format '{{.State.Running}}')" = true ] ||
            { run_podman logs "$container"; fail "the server stopped"; }
        ((SECONDS - started < 240)) || { run_podman logs "$container"; fail "not ready after 240 s"; }
        sleep 0.5
    done
    echo "ready in $((SECONDS - started)) s"
    ! run_podman logs "$container" 2>&1 | grep --quiet "compiling for this processor" ||
        fail "it compiles what the image should hold"
}
stop_server() {
    say "stopping it"
    started=$SECONDS
    run_podman stop --time 10 "$container" >/dev/null
    code=$(run_podman inspect "$container" --format '{{.State.ExitCode}}')
    echo "stopped in $((SECONDS - started)) s with exit code $code"
    [ "$code" -eq 0 ] || { run_podman logs "$container"; fail "exit code $code on SIGTERM"; }
    run_podman rm "$container" >/dev/null
}

say "running it read-only"
start_server

run_podman exec "$container" python -c '
import importlib.util, os
assert os.getuid() != 0, "runs as root"
folders = [*os.environ["PATH"].split(":"), "/bin", "/sbin", "/usr/sbin", "/usr/local/sbin"]
for shell in ("sh", "bash", "dash", "ash", "busybox"):
    found = [folder for folder in folders if os.path.lexists(f"{folder}/{shell}")]
    assert not found, f"{shell} is in {found}"
for module in ("torch", "training", "pip"):
    assert importlib.util.find_spec(module) is None, f"{module} is in the image"
try:
    open("/opt/nafir/probe", "w")
except OSError:
    print("uid", os.getuid(), "- read-only root, no shell, no torch, no training side")
else:
    raise SystemExit("the root file system is writable")
'
mapfile -t check < <(run_podman image inspect "$image" --format '{{json .HealthCheck.Test}}' |
    python3 -c 'import json, sys; print(*json.load(sys.stdin)[1:], sep="\n")')
run_podman exec "$container" "${check[@]}" || fail "the health check fails on a ready server"
echo "health check passes"

# Stereo wavs of floats with sound in them, each ten decibels louder than the one before.
check_responses() {
    python3 - "$@" <<'PYTHON'
import math
import struct
import sys

before_db = -math.inf
for path in sys.argv[1:]:
    data = open(path, "rb").read()
    assert data[:4] == b"RIFF" and data[8:12] == b"WAVE", f"not a wav: {data[:16]!r}"
    chunks, at = {}, 12
    while at + 8 <= len(data):
        size = struct.unpack_from("<I", data, at + 4)[0]
        chunks[data[at : at + 4]] = data[at + 8 : at + 8 + size]
        at += 8 + size + size % 2
    code, channels, rate, _, _, bits = struct.unpack_from("<HHIIHH", chunks[b"fmt "])
    assert (channels, bits) == (2, 32), f"{channels} channels, {bits} bits"
    samples = struct.unpack(f"<{len(chunks[b'data']) // 4}f", chunks[b"data"])
    peak = max(map(abs, samples))
    assert 0 < peak < 1e3, f"peak {peak}"
    energy_db = 10 * math.log10(sum(sample**2 for sample in samples))
    frames = len(samples) // channels
    print(f"{len(data)} bytes: {frames} frames x {channels} at {rate} Hz, format {code}, peak {peak:.4f}, {energy_db:.1f} dB")
    assert energy_db > before_db + 10, f"{path} has {energy_db:.1f} dB, the one before {before_db:.1f}"
    before_db = energy_db
PYTHON
}
get() { curl --silent --show-error --fail "$@"; }

say "asking for the page and an impulse response"
page=$(get "$url/")
[[ ${page,,} == *"<!doctype html"* ]] || fail "no page at /"
get --output "$state/ir.wav" "$url/v1/scenes/$scene/impulse-response?$query"
check_responses "$state/ir.wav"

say "asking for the house with a door shut and open"
for openness in 0 1; do
    get --output "$state/door$openness.wav" "$url/v1/scenes/house/impulse-response?$house_query&door=$house_door=$openness"
done
check_responses "$state/door0.wav" "$state/door1.wav"

say "walking through the scene for three seconds"
# From inside, where what the client imports is installed; /dev/shm is the only place to write.
tar --create --directory "$root/client_examples/python" nafir_client walk.py |
    run_podman exec --interactive "$container" python -c "$unpack"
run_podman exec "$container" python /dev/shm/walk.py --url "ws://127.0.0.1:$port" --scene "$scene" \
    --seconds 3 -o /dev/shm/heard.wav

say "opening a door of the house in a stream"
run_podman exec --interactive --workdir /dev/shm "$container" python - "ws://127.0.0.1:$port" "$house_door" <<'PYTHON'
import asyncio
import sys

import nafir_client
import numpy as np


async def listen(url: str, door: str) -> None:
    async with nafir_client.connect(url, scene="house", reconnect=None) as stream:
        await stream.move_listener((2, 3, 1.6), yaw=0.0)
        clip = await stream.add_emitter(clip="woman-reading", position=(6, 2, 1.5))
        levels_db = []
        # A second for what is to be computed, and two to be heard.
        for openness in (0.0, 1.0):
            await stream.set_door(door, openness)
            start, heard = None, []
            async for block in stream:
                start = max(clip.start_clock, block.sample_clock) if start is None else start
                if block.sample_clock >= start + stream.sample_rate:
                    heard.append(block.samples)
                if block.sample_clock >= start + 3 * stream.sample_rate:
                    break
            levels_db.append(10 * np.log10(np.mean(np.square(np.concatenate(heard, axis=1)))))
        shut_db, open_db = levels_db
        print(f"{door} shut {shut_db:.1f} dB, open {open_db:.1f} dB; {stream.statistics.blocks_late} blocks late")
        assert open_db > shut_db + 10


asyncio.run(listen(*sys.argv[1:]))
PYTHON

stop_server

# deploy/compose.yaml itself, in its own networks. Images that it names are pulled with PULL_BASE=1, or made of the base and the
# program of this name that the host has, Grafana's of the folder GRAFANA; a service without either is left out.
say "running deploy/compose.yaml"
! curl --silent --output /dev/null http://127.0.0.1:80 || fail "port 80, which Caddy takes, is in use"
deploy=$state/deploy
secrets=$deploy/secrets
rm -rf "$deploy"
cp --recursive "$root/deploy" "$deploy"
mkdir -p "$secrets/keys"
printf 'IMAGE=localhost/%s\nDOMAIN=localhost\nRESUME_SECRET=%s\n' "$image" "$(head -c 18 /dev/urandom | base64)" >"$deploy/.env"
nafir_keys() { run_podman run --rm --no-healthcheck --network none "${ulimits[@]}" --volume "$secrets/keys:/keys" --user 0 "$image" keys "$@"; }
nafir_keys create --file /keys/keys.json --scope metrics >"$secrets/metrics-key"
echo container-test >"$secrets/grafana-password"
chmod 644 "$secrets/keys/keys.json" "$secrets/metrics-key" "$secrets/grafana-password"

make_image() {
    mkdir -p "$state/$1"
    cp --recursive --no-target-directory "$3" "$state/$1/files"
    printf 'FROM localhost/%s\nCOPY files %s\n%s\n' "$base" "$4" "$5" >"$state/$1/Dockerfile"
    buildah "${store[@]}" bud --quiet --isolation chroot --format docker --pull-never --tag "$2" "$state/$1" >/dev/null
}
services=(server)
for wanted in $(sed -n 's/^ *image: \([a-z]\)/\1/p' "$deploy/compose.yaml"); do
    service=${wanted##*/}
    service=${service%%:*}
    [[ $wanted = */* ]] || wanted=library/$wanted
    wanted=docker.io/$wanted
    if run_podman image exists "$wanted"; then
        :
    elif [ -n "${PULL_BASE:-}" ]; then
        run_podman pull --quiet "$wanted"
    elif [ "$service" = caddy ] && command -v caddy >/dev/null; then
        make_image caddy "$wanted" "$(command -v caddy)" /usr/bin/caddy 'ENV XDG_DATA_HOME=/data XDG_CONFIG_HOME=/config
CMD ["caddy", "run", "--config", "/etc/caddy/Caddyfile", "--adapter", "caddyfile"]'
    elif [ "$service" = prometheus ] && command -v prometheus >/dev/null; then
        make_image prometheus "$wanted" "$(command -v prometheus)" /usr/bin/prometheus 'RUN mkdir /prometheus && chown 65534:65534 /prometheus
USER 65534
ENTRYPOINT ["prometheus"]'
    elif [ "$service" = grafana ] && [ -n "${GRAFANA:-}" ]; then
        [[ " ${services[*]} " = *" prometheus "* ]] || fail "prometheus, which Grafana asks, is not installed"
        # The paths, the user and the start script of Grafana's own image.
        make_image grafana "$wanted" "$GRAFANA" /usr/share/grafana 'ENV GF_PATHS_CONFIG=/etc/grafana/grafana.ini \
    GF_PATHS_HOME=/usr/share/grafana GF_PATHS_DATA=/var/lib/grafana GF_PATHS_LOGS=/var/log/grafana \
    GF_PATHS_PLUGINS=/var/lib/grafana/plugins GF_PATHS_PROVISIONING=/etc/grafana/provisioning \
    PATH=/usr/share/grafana/bin:/usr/sbin:/usr/bin:/sbin:/bin
RUN mkdir -p /etc/grafana /var/lib/grafana/plugins /var/log/grafana && cp /usr/share/grafana/conf/sample.ini /etc/grafana/grafana.ini \
    && cp --recursive /usr/share/grafana/conf/provisioning /etc/grafana \
    && chown -R 472:0 /var/lib/grafana /var/log/grafana
USER 472
ENTRYPOINT ["bash", "/usr/share/grafana/packaging/docker/run.sh"]'
    else
        echo "$service is left out: it has no image"
        continue
    fi
    services+=("$service")
done
[[ " ${services[*]} " = *" caddy "* ]] || fail "caddy is not installed"
[[ " ${services[*]} " != *" grafana "* ]] || ! curl --silent --output /dev/null http://127.0.0.1:3000 || fail "port 3000, which Grafana takes, is in use"

# podman-compose's podman: the store of this script, and the limits that this host can give.
printf '[containers]\ndefault_ulimits = ["nofile=1024:1024", "nproc=4096:4096"]\n' >"$state/containers.conf"
cat >"$state/podman" <<PODMAN
#!/usr/bin/env bash
arguments=()
for argument in "\$@"; do
    # Where nobody may run at real-time priority. Podman asks for more processes than there may be unless it is told.
    [[ \$argument != rtprio=* || $(ulimit -Hr) != 0 ]] || argument=nproc=4096:4096
    arguments+=("\$argument")
done
CONTAINERS_CONF=$state/containers.conf exec $(command -v podman) ${store[*]} \
    --runtime $(command -v runc) --cgroup-manager cgroupfs "\${arguments[@]}"
PODMAN
chmod +x "$state/podman"
run_compose() { (cd "$deploy" && podman-compose --podman-path "$state/podman" --project-name nafir-test "$@") >>"$state/compose.log" 2>&1; }
: >"$state/compose.log"
composed=yes
started=$SECONDS
run_compose up --detach --no-build "${services[@]}" || { cat "$state/compose.log"; fail "compose does not start"; }
container=nafir-test_server_1
tls=https://localhost
authority=$state/root.crt
until run_podman cp nafir-test_caddy_1:/data/caddy/pki/authorities/local/root.crt "$authority" 2>/dev/null &&
    curl --silent --fail --output /dev/null --cacert "$authority" "$tls/livez" &&
    run_podman exec "$container" "${check[@]}" 2>/dev/null; do
    ((SECONDS - started < 180)) || { cat "$state/compose.log"; run_podman logs "$container"; fail "not ready behind TLS after 180 s"; }
    sleep 0.5
done
echo "${services[*]}: ready behind TLS in $((SECONDS - started)) s"
! run_podman logs "$container" 2>&1 | grep --quiet "compiling for this processor" ||
    fail "it compiles what the image should hold"
run_podman exec "$container" python -c 'open("/cache/probe", "w")' || fail "nothing can be kept in /cache"

key=$(nafir_keys create --file /keys/keys.json --scope listen --scope render)
status() { curl --silent --output /dev/null --write-out '%{http_code}' --cacert "$authority" "$@"; }
for path in /v1/scenes /readyz / /main.js /docs /redoc /openapi.json; do
    [ "$(status "$tls$path")" = 401 ] || fail "$path is told without a key"
done
made=$SECONDS
until [ "$(status -H "Authorization: Bearer $key" "$tls/v1/scenes")" = 200 ]; do
    ((SECONDS - made < 20)) || fail "a key made while the server runs opens nothing after 20 s"
    sleep 0.5
done
for path in /readyz / /main.js /docs; do
    [ "$(status --user "anybody:$key" "$tls$path")" = 200 ] || fail "a key given as a password does not open $path"
done
[ "$(status -H "Authorization: Bearer $(<"$secrets/metrics-key")" "$tls/metrics")" = 404 ] || fail "metrics can be read from outside"
if [[ " ${services[*]} " = *" prometheus "* ]]; then
    run_podman exec "$container" python -c '
import json, time, urllib.request

for _ in range(60):
    targets = json.load(urllib.request.urlopen("http://prometheus:9090/api/v1/targets"))["data"]["activeTargets"]
    if [target["health"] for target in targets] == ["up"]:
        break
    time.sleep(1)
else:
    raise SystemExit(f"Prometheus reads no metrics: {targets}")
print("Prometheus reads", targets[0]["scrapeUrl"])
'
fi
# From outside the networks of compose, through the port of Caddy, by a user who is not root.
chmod 644 "$authority"
run_client() {
    run_podman run --rm --no-healthcheck --network host "${ulimits[@]}" --volume "$root/client_examples/python/nafir_client:/client/nafir_client:ro" \
        --volume "$authority:/client/root.crt:ro" --workdir /client --env "NAFIR_API_KEY=$key" --env SSL_CERT_FILE=/client/root.crt \
        --entrypoint python "$@"
}
run_client "$image" -c '
import sys

import soundfile
from nafir_client.command_line import main

try:
    main()
except SystemExit as end:
    if end.code:
        raise
samples, rate = soundfile.read("/dev/shm/heard.wav")
peak = abs(samples).max()
print(f"{len(samples) / rate:.2f} s heard through wss, peak {peak:.4f}")
assert len(samples) > 2 * rate and 0.001 < peak <= 1, "silence"
' listen wss://localhost --scene "$scene" --seconds 3 --silent --output /dev/shm/heard.wav

if [[ " ${services[*]} " = *" prometheus "* ]]; then
    say "putting the dashboard's queries to Prometheus"
    grafana_password=
    [[ " ${services[*]} " != *" grafana "* ]] || grafana_password=$(<"$secrets/grafana-password")
    if [ -n "$grafana_password" ]; then
        started=$SECONDS
        # By the port that compose publishes.
        until get --output "$state/grafana.json" http://127.0.0.1:3000/api/health 2>/dev/null; do
            ((SECONDS - started < 120)) || { run_podman logs nafir-test_grafana_1; fail "Grafana is not healthy after 120 s"; }
            sleep 0.5
        done
        echo "Grafana is healthy: $(tr -d '\n' <"$state/grafana.json")"
    fi
    run_client --detach --name "$listener" "$image" -c 'from nafir_client.command_line import main; main()' \
        listen wss://localhost --scene "$scene" --seconds 120 --silent --output /dev/shm/heard.wav >/dev/null
    run_podman exec --interactive "$container" python - "$grafana_password" "$(<"$deploy/grafana/nafir.json")" <"$root/tests/integration/dashboard.py" ||
        { [ -z "$grafana_password" ] || run_podman logs nafir-test_grafana_1; run_podman logs "$listener" || true; fail "the dashboard"; }
    run_podman stop --time 10 "$listener" >/dev/null
    if [ -n "$grafana_password" ] && run_podman logs nafir-test_grafana_1 2>&1 | grep logger=provisioning | grep --extended-regexp '(lvl=eror|level=error)'; then
        fail "Grafana complains about its provisioning"
    fi
fi

say "stopping it"
started=$SECONDS
run_compose stop server
code=$(run_podman inspect "$container" --format '{{.State.ExitCode}}')
echo "stopped in $((SECONDS - started)) s with exit code $code"
[ "$code" -eq 0 ] || { run_podman logs "$container"; fail "exit code $code on SIGTERM"; }
say "container test passed"
