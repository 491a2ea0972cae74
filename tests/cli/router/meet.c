/* A component of tests/cli/router/meet.rs: it asks all others until each has answered, and answers them.
 *     meet station PATH-OF-THE-BROKER|router HOST:PORT  OWN OTHER...      mailboxes as numbers
 * KEYS names the directory of its keys, for a router that is reached by TLS. */
#include <errno.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "rtnet_packages.h"

#define MOST 16
#define ASK 21
/* Rounds of a while each, or of a package. */
#define MOST_ROUNDS 600

static const struct rtnet_shape SHAPE = {8, 64, 16, 0};
static const int64_t A_WHILE = 50000000;

static int32_t checked(int32_t told, const char *what) {
    if (told < 0) {
        fprintf(stderr, "%s: %s\n", what, rtnet_packages_error());
        exit(1);
    }
    return told;
}

/* Whether it shows what it should of a connection through which packages have come: the status may be a moment older than they are. */
static int shows_its_connection(const rtnet_component *component, int is_of_router) {
    struct rtnet_router_status status;
    int32_t told = rtnet_component_router_status(component, &status);
    if (!is_of_router) {
        return told == -EOPNOTSUPP;
    }
    checked(told, "its connection");
    return status.is_connected && status.mailboxes == 1 && status.received > 0;
}

int main(int argc, char **argv) {
    rtnet_component *component;
    rtnet_mailbox *own;
    rtnet_sender *to[MOST];
    uint32_t names[MOST];
    int answered[MOST] = {0}, count = argc - 4, left = count, has_met = 0, rounds = 0;
    if (count < 1 || count > MOST) {
        return 2;
    }
    if (strcmp(argv[1], "router") == 0) {
        checked(rtnet_component_of_router(argv[2], getenv("KEYS"), 0, &component), argv[2]);
    } else {
        checked(rtnet_component_attach(argv[2], &component), argv[2]);
    }
    checked(rtnet_mailbox_create(component, (uint32_t)strtoul(argv[3], NULL, 0), &SHAPE, &own), argv[3]);
    for (int other = 0; other < count; other++) {
        names[other] = (uint32_t)strtoul(argv[4 + other], NULL, 0);
        checked(rtnet_sender_bind(own, names[other], &to[other]), argv[4 + other]);
    }
    for (;;) {
        struct rtnet_head head;
        char body[64];
        for (int other = 0; other < count; other++) {
            if (!answered[other]) {
                /* One that finds no room is asked again. */
                rtnet_sender_send(to[other], ASK, "who", 3);
            }
        }
        if (!has_met && left == 0 && shows_its_connection(component, strcmp(argv[1], "router") == 0)) {
            has_met = 1;
            puts("met");
            fflush(stdout);
        }
        if (!has_met && ++rounds > MOST_ROUNDS) {
            fprintf(stderr, "%d have not answered\n", left);
            return 1;
        }
        while (rtnet_mailbox_receive(own, &head, body, sizeof body, A_WHILE) >= 0) {
            if (head.kind == ASK) {
                rtnet_sender *back;
                checked(rtnet_sender_bind(own, head.from, &back), "a sender for an answer");
                head.kind = RTNET_OK;
                rtnet_sender_send_with(back, &head, body, head.len);
                rtnet_sender_unbind(back);
                continue;
            }
            for (int other = 0; other < count; other++) {
                if (names[other] == head.from && head.kind == RTNET_OK && !answered[other]) {
                    answered[other] = 1;
                    left--;
                }
            }
        }
    }
}
