#!/bin/sh
# Starts the queue's Redis: nobody gets in without the password, and with it one user may do what RQ and photonfarm need.
# The password is made at the first start, unless there is one, and lies in a file that the services share; it stands in
# no command line, no environment and no log.
set -eu

data=${REDIS_DATA:-/data}
password=${PHOTONFARM_REDIS_PASSWORD_FILE:-/run/photonfarm/redis_password}

if [ ! -s "$password" ]; then
    head -c 32 /dev/urandom | sha256sum | cut -d ' ' -f 1 > "$password.new"
    chmod 0444 "$password.new" # the services have other users; who can reach the folder is said by who mounts it
    mv "$password.new" "$password"
fi
digest=$(tr -d '\n' < "$password" | sha256sum | cut -d ' ' -f 1)

# Commands: of RQ 3.0, of redis-py's locks and of photonfarm; keys and values of other kinds are out of reach.
umask 077
cat > "$data/users.acl" << ACL
user default off
user photonfarm on #$digest ~rq:* +@read +@write +@transaction +@connection +@scripting +@blocking -@dangerous +info
ACL

# The queue is disposable, but a journal saves the workers a reconcile; nothing may be evicted from a queue. 10 000
# jobs, the most of a scene, take 20 MB.
exec "${REDIS_SERVER:-redis-server}" \
    --bind "${REDIS_BIND:-*}" --port "${REDIS_PORT:-6379}" --aclfile "$data/users.acl" \
    --dir "$data" --save "" --appendonly yes --appendfsync everysec \
    --maxmemory 256mb --maxmemory-policy noeviction --daemonize no
