#!/bin/sh
# Makes a certificate authority and certificates for one site, here: make.sh HOST ROBOT...
# For a trial or a small site; an authority of your own writes the same files.
set -eu
umask 077
cd "$(dirname "$0")"
[ $# -ge 1 ] || { echo "usage: make.sh HOST [ROBOT...], e.g. make.sh map.example.org robot-1" >&2; exit 2; }
host=$1
shift
new() { openssl ecparam -name prime256v1 -genkey -noout -out "$1.key"; }
[ -f ca.pem ] || {
  new ca
  openssl req -x509 -new -key ca.key -days 3650 -subj "/CN=gpom site" -out ca.pem
}
for name in router map proxy "$@"; do
  [ -f "$name.pem" ] && continue
  new "$name"
  openssl req -new -key "$name.key" -subj "/CN=$name" -out "$name.csr"
  printf 'subjectAltName=DNS:%s,DNS:%s,DNS:localhost\n' "$name" "$host" > "$name.ext"
  openssl x509 -req -in "$name.csr" -CA ca.pem -CAkey ca.key -CAcreateserial -days 825 \
    -extfile "$name.ext" -out "$name.pem"
  rm "$name.csr" "$name.ext"
done
# The token by which the proxy may ask the service; people never see it.
[ -f map.env ] || {
  token=$(openssl rand -hex 24)
  echo "GPOM_ACCESS__READ_TOKENS=$token" > map.env
  echo "proxy_set_header Authorization \"Bearer $token\";" > token.conf
}
# The same token for Prometheus: GPOM_METRICS_TOKEN=./tls/metrics.token with compose.monitoring.yaml.
sed -n 's/^GPOM_ACCESS__READ_TOKENS=//p' map.env | tr -d '\n' > metrics.token
# The services run as users without a name here; ca.key stays with whoever made it.
chmod 644 ./*.pem token.conf metrics.token router.key map.key proxy.key
