/* A client of tests/cli/router/restarts.rs: it sends numbers to a mailbox until its standard input ends, answers questions, and receives
 * numbers, each larger than the one before. Then it says, again and again, how many packages were taken, were lost of these, were not passed
 * on, and are unconfirmed; and how many numbers came, and how many of those were not larger.
 *     flood HOST:PORT OWN TO      mailboxes as numbers */
#include <inttypes.h>
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#include "rtnet_packages.h"

#define ASK 21
#define DATA (-6)

static const struct rtnet_shape SHAPE = {8, 64, 16, 0};
static const int64_t SENDS_EVERY = 2000000, SAYS_EVERY = 100000000;

static int32_t checked(int32_t result, const char *what) {
    if (result < 0) {
        fprintf(stderr, "%s: %s\n", what, rtnet_packages_error());
        exit(1);
    }
    return result;
}

int main(int argc, char **argv) {
    rtnet_component *component;
    rtnet_mailbox *own;
    rtnet_sender *to, *back;
    struct rtnet_head head;
    char body[64];
    int is_over = 0;
    uint64_t taken = 0, came = 0, again = 0, newest = 0;
    if (argc != 4) {
        return 2;
    }
    checked(rtnet_component_of_router(argv[1], NULL, 0, &component), argv[1]);
    checked(rtnet_mailbox_create(component, (uint32_t)strtoul(argv[2], NULL, 0), &SHAPE, &own), argv[2]);
    checked(rtnet_sender_bind(own, (uint32_t)strtoul(argv[3], NULL, 0), &to), argv[3]);
    for (;;) {
        struct pollfd input = {0, POLLIN, 0};
        is_over = is_over || poll(&input, 1, 0) > 0;
        if (is_over) {
            struct rtnet_router_status of;
            checked(rtnet_component_router_status(component, &of), "its connection");
            printf("%" PRIu64 " %" PRIu64 " %" PRIu64 " %" PRIu64 " %" PRIu64 " %" PRIu64 "\n", taken, of.not_connected + of.not_written,
                   of.lost_at_router, of.unconfirmed, came, again);
            fflush(stdout);
        } else {
            uint8_t number[8];
            for (int byte = 0; byte < 8; byte++) {
                number[byte] = (uint8_t)(taken >> 8 * byte);
            }
            /* One that finds no room is not taken. */
            taken += rtnet_sender_send(to, DATA, number, sizeof number) >= 0;
        }
        if (rtnet_mailbox_receive(own, &head, body, sizeof body, is_over ? SAYS_EVERY : SENDS_EVERY) < 0) {
            continue;
        }
        if (head.kind == DATA) {
            uint64_t number = 0;
            for (int byte = 0; byte < 8; byte++) {
                number |= (uint64_t)(uint8_t)body[byte] << 8 * byte;
            }
            came++;
            again += number <= newest;
            newest = number;
        } else if (head.kind == ASK) {
            checked(rtnet_sender_bind(own, head.from, &back), "a sender for an answer");
            head.kind = RTNET_OK;
            rtnet_sender_send_with(back, &head, body, head.len);
            rtnet_sender_unbind(back);
        }
    }
}
