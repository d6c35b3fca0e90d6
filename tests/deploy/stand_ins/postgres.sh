# Like the official image: the first start creates a cluster for POSTGRES_USER, POSTGRES_PASSWORD_FILE and POSTGRES_DB.
set -eu
bin=$(echo /usr/lib/postgresql/*/bin)
if [ ! -s "$PGDATA/PG_VERSION" ]; then
  "$bin/initdb" -D "$PGDATA" -U "$POSTGRES_USER" -A scram-sha-256 --pwfile "$POSTGRES_PASSWORD_FILE" -E UTF8 --locale=C > /dev/null
  echo "host all all all scram-sha-256" >> "$PGDATA/pg_hba.conf"
  echo "CREATE DATABASE \"$POSTGRES_DB\"" | "$bin/postgres" --single -D "$PGDATA" postgres > /dev/null
fi
exec "$bin/postgres" -D "$PGDATA" -h '*' -k /tmp
