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

static const struct rtnet_shape SHAPE = {8, 64, 16, 0};
static const int64_t A_WHILE = 50000000;

static int32_t checked(int32_t told, const char *what) {
    if (told < 0) {
        fprintf(stderr, "%s: %s\n", what, rtnet_packages_error());
        exit(1);
    }
    return told;
}

static void shows_its_connection(const rtnet_component *component, int is_of_router) {
    struct rtnet_router_status status;
    int32_t told = rtnet_component_router_status(component, &status);
    if (is_of_router) {
        checked(told, "its connection");
    }
    if (is_of_router ? !status.is_connected || status.mailboxes != 1 || status.received == 0 : told != -EOPNOTSUPP) {
        fprintf(stderr, "status %d, connected %u, mailboxes %u\n", told, status.is_connected, status.mailboxes);
        exit(1);
    }
}

int main(int argc, char **argv) {
    rtnet_component *component;
    rtnet_mailbox *own;
    rtnet_sender *to[MOST];
    uint32_t names[MOST];
    int answered[MOST] = {0}, count = argc - 4, left = count;
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
        while (rtnet_mailbox_receive(own, &head, body, sizeof body, A_WHILE) >= 0) {
            for (int other = 0; other < count; other++) {
                if (names[other] != head.from) {
                    continue;
                }
                if (head.kind == ASK) {
                    head.kind = RTNET_OK;
                    rtnet_sender_send_with(to[other], &head, body, head.len);
                } else if (head.kind == RTNET_OK && !answered[other]) {
                    answered[other] = 1;
                    if (--left == 0) {
                        shows_its_connection(component, strcmp(argv[1], "router") == 0);
                        puts("met");
                        fflush(stdout);
                    }
                }
            }
        }
    }
}
