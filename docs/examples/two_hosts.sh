#!/bin/sh
# Trains on two hosts, or in two terminals of one, which then act as two hosts:
#
#   sh docs/examples/two_hosts.sh 0                    # in the first terminal
#   sh docs/examples/two_hosts.sh 1                    # in the second one
#
# On two machines, set COORDINATOR to the address of the first one, with a free port, in both terminals. TASK is a task,
# OUT a folder that both can read, such as one of a network file system. Further arguments go to crazysim, the same on
# both: sh docs/examples/two_hosts.sh 0 --resume continues after a host was lost.
set -eu
host=$1
shift
exec crazysim train "${TASK:-hover}" --out "${OUT:-out/two_hosts}" --checkpoint-every 60 \
  --coordinator "${COORDINATOR:-127.0.0.1:12345}" --hosts 2 --host-id "$host" "$@"
