# Read by run.sh: the overlays for production and monitoring, run for real. Where their images
# cannot be had, Debian's nginx and Prometheus stand in; Grafana has no stand-in, so its queries are
# put to Prometheus instead.
export GPOM_HTTPS_PORT=${GPOM_HTTPS_PORT:-18443} GPOM_PROMETHEUS_PORT=${GPOM_PROMETHEUS_PORT:-19090}
export GPOM_HTTPS_ADDRESS=127.0.0.1 GPOM_ZENOH_ADDRESS=127.0.0.1 GPOM_TLS=$work/tls

stand_in() { # IMAGE, and what a Dockerfile says after FROM
  if $docker image inspect "$1" > /dev/null 2>&1 || $docker pull -q "$1" > /dev/null 2>&1; then return; fi
  if ! $docker image inspect gpom-tools > /dev/null 2>&1; then
    mmdebstrap -q --variant=apt --include=nginx-light,prometheus,ca-certificates \
      --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-exclude=/usr/share/man/*' \
      trixie "$work/tools.tar"
    $docker import "$work/tools.tar" gpom-tools > /dev/null
    rm -f "$work/tools.tar"
  fi
  printf 'FROM gpom-tools\n%b\n' "$2" | $docker build -q -t "$1" - > /dev/null
  echo "    (Debian's stands in for $1)"
}

image_of() { sed -n "s|^    image: \($1.*\)\$|\1|p" docker/compose.*.yaml; }

production() {
  rm -rf "$GPOM_TLS" && mkdir -p "$GPOM_TLS"
  cp docker/tls/make.sh "$GPOM_TLS"
  sh "$GPOM_TLS/make.sh" localhost robot-1 robot-2 > /dev/null 2>&1
  echo "anna:$(openssl passwd -apr1 secret)" > "$GPOM_TLS/users"
  stand_in "$(image_of nginx)" 'CMD ["nginx", "-g", "daemon off;"]'
  compose=(docker-compose -f docker/compose.yaml -f docker/compose.production.yaml)
  up || { cat "$work/up.log"; bad "production does not become healthy"; }
  local https=https://localhost:$GPOM_HTTPS_PORT
  status_of() { curl -s -m 10 -o "$work/answer" -w '%{http_code}' --cacert "$GPOM_TLS/ca.pem" "$@"; }
  for _ in $(seq 20); do [ "$(status_of "$https/")" = 401 ] && break; sleep .5; done
  [ "$(status_of "$https/v1/status")" = 401 ] || bad "production answers without a password"
  [ "$(status_of -u anna:wrong "$https/v1/status")" = 401 ] || bad "a wrong password is let in"
  [ "$(status_of -u anna:secret "$https/v1/status")" = 200 ] || bad "a right password is refused"
  [ "$(status_of -u anna:secret "$https/")" = 200 ] || bad "no page through the proxy"
  [ "$(status_of -u anna:secret -X POST "$https/v1/flush")" = 403 ] || bad "people can make it work"
  [ "$(status_of -u anna:secret "$https/metrics")" = 404 ] || bad "metrics can be seen outside"
  ! curl -s -m 5 "$url/healthz" > /dev/null || bad "the service can be reached past the proxy"
  { curl -sN -m 4 --cacert "$GPOM_TLS/ca.pem" -u anna:secret "$https/v1/events" || :; } > "$work/news"
  grep -q "event: map" "$work/news" || bad "no events through the proxy"
  ok "production: TLS, names and passwords, reading only, no way past the proxy"

  robot() { # NAME, and whose certificate it has
    sed "s/robot-1/$2/" docker/robot.production.json5 > "$work/robot.json5"
    timeout 60 $docker run --rm --name gpom-test-robot --user 0 --network gpom-test_default -v "$GPOM_TLS:/tls:ro" \
      -v "$work/robot.json5:/robot.json5:ro" -e ZENOH_CONFIG=/robot.json5 gpom:test \
      simulate --robots 1 --robot "$1" --connect tls/router:7447 --duration 6 > "$work/robot.log" 2>&1 && return
    $docker rm -f gpom-test-robot > /dev/null 2>&1 || :
    return 1
  }
  seen() { status_of -u anna:secret "$https/v1/status" > /dev/null; field "['robots']" < "$work/answer"; }
  robot robot-1 robot-1 || { cat "$work/robot.log"; bad "a robot with a certificate is not heard"; }
  grep -q "'robot-1'" <<< "$(seen)" || bad "the robot is not in the map: $(seen)"
  ! robot liar robot-1 || bad "a robot can speak under another name"
  ! grep -q liar <<< "$(seen)" || bad "a robot can speak under another name"
  ok "production: a robot with its certificate is heard, under its own name only"

  prometheus_image
  export GPOM_METRICS_TOKEN=$GPOM_TLS/metrics.token
  compose+=(-f docker/compose.monitoring.yaml)
  "${compose[@]}" up -d --no-build prometheus > "$work/up.log" 2>&1 || { cat "$work/up.log"; bad "no Prometheus beside production"; }
  sees() { curl -s -m 5 "http://127.0.0.1:$GPOM_PROMETHEUS_PORT/api/v1/query?query=up" | field "['data']['result'][0]['value'][1]" 2> /dev/null; }
  for _ in $(seq 60); do [ "$(sees)" = 1 ] && break; sleep 1; done
  [ "$(sees)" = 1 ] || bad "Prometheus is not let in by a service with tokens"
  ok "production: Prometheus is let in by its token"
  "${compose[@]}" down -v -t 10 > /dev/null 2>&1
  unset GPOM_METRICS_TOKEN
}

prometheus_image() {
  stand_in "$(image_of prom/prometheus)" \
    'RUN mkdir /prometheus && chown 65534 /prometheus\nUSER 65534\nENTRYPOINT ["prometheus"]'
}

monitoring() {
  prometheus_image
  compose=(docker-compose -f docker/compose.yaml -f docker/compose.monitoring.yaml --profile demo)
  "${compose[@]}" up -d --no-build --wait --wait-timeout 400 map robots prometheus \
    > "$work/up.log" 2>&1 || { cat "$work/up.log"; bad "monitoring does not become healthy"; }
  python3 tests/containers/dashboard.py "http://127.0.0.1:$GPOM_PROMETHEUS_PORT" ||
    bad "Prometheus does not see what the dashboard shows"
  ok "monitoring: Prometheus has its rules, and an answer to every query of the dashboard"
}
