/* A component in C, which exchanges packages with one in Rust: tests/exchange.rs starts it with the path of a broker. It says what
 * was not as it should be, and ends with 1. */
#include <errno.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "rtnet_packages.h"

#define CHECK(is_so)                                                                                             \
    do {                                                                                                         \
        if (!(is_so)) {                                                                                          \
            fprintf(stderr, "%s:%d: not so: %s; %s\n", __FILE__, __LINE__, #is_so, rtnet_packages_error());       \
            exit(1);                                                                                             \
        }                                                                                                        \
    } while (0)

/* What was returned is that error, and what is said of it has that text in it. */
#define REFUSED(told, error, text)                                                                               \
    do {                                                                                                         \
        CHECK((told) == -(error));                                                                               \
        CHECK(strncmp(rtnet_packages_error(), #error " in rtnet_", sizeof #error " in rtnet_" - 1) == 0);         \
        CHECK(strstr(rtnet_packages_error(), text) != NULL);                                                     \
    } while (0)

/* The layout is the library's, too. */
typedef char head_has_16_bytes[sizeof(struct rtnet_head) == 16 ? 1 : -1];
typedef char kind_is_there[offsetof(struct rtnet_head, kind) == 12 ? 1 : -1];
typedef char order_is_there[offsetof(struct rtnet_head, big_endian) == 15 ? 1 : -1];
typedef char journey_has_88_bytes[sizeof(struct rtnet_journey) == 88 ? 1 : -1];
typedef char age_is_there[offsetof(struct rtnet_journey, age_ns) == 72 ? 1 : -1];
typedef char shape_has_16_bytes[sizeof(struct rtnet_shape) == 16 ? 1 : -1];

static const uint32_t OWN = RTNET_MAILBOX_NAME(0, 0x81, 0, 0);
static const uint32_t ECHO = RTNET_MAILBOX_NAME(0, 0x80, 0, 0);
static const struct rtnet_shape SHAPE = {4, 64, 4, 0};
static const int64_t SECONDS = 1000000000;

static void commands_are_answered(rtnet_mailbox *own, rtnet_sender *echo) {
    uint8_t body[64], back[64];
    for (uint32_t count = 0; count < 500; count++) {
        uint32_t len = count % 65;
        struct rtnet_head head;
        memset(body, (int)count, sizeof body);
        memset(back, 0, sizeof back);
        int32_t id = rtnet_sender_send(echo, 21, body, len);
        CHECK(id >= 0 && id <= 255);
        CHECK(rtnet_mailbox_receive(own, &head, back, sizeof back, 20 * SECONDS) == (int32_t)len);
        CHECK(head.from == ECHO && head.to == OWN && head.len == len);
        CHECK(head.kind == RTNET_OK && head.id == id && head.big_endian == 0);
        CHECK(memcmp(body, back, len) == 0 && (len == 64 || back[len] == 0));
    }
    CHECK(rtnet_sender_set_priority(echo, 77) == 0);
    CHECK(rtnet_sender_send(echo, 21, NULL, 0) >= 0);
    struct rtnet_head head;
    CHECK(rtnet_mailbox_receive(own, &head, NULL, 0, RTNET_FOR_EVER) == 0);
    CHECK(head.priority == 77);
    struct rtnet_head command = {1, 2, 3, 21, 9, 200, 1};
    CHECK(rtnet_sender_send_with(echo, &command, "abc", 3) == 0);
    CHECK(rtnet_mailbox_receive(own, &head, back, 3, 20 * SECONDS) == 3);
    CHECK(head.priority == 9 && head.id == 200 && head.from == ECHO && memcmp(back, "abc", 3) == 0);
    /* What the server in Rust says of the order that it saw. */
    CHECK(head.big_endian == 1);
    command.big_endian = 2;
    REFUSED(rtnet_sender_send_with(echo, &command, "abc", 3), EINVAL, "it is 0 or 1");
}

static void who_waits_is_told_when_it_is_over(rtnet_mailbox *own) {
    struct timespec begun, ended;
    REFUSED(rtnet_mailbox_receive(own, NULL, NULL, 0, RTNET_AT_ONCE), EAGAIN, "nothing waits: come again");
    REFUSED(rtnet_mailbox_peek(own, NULL, RTNET_AT_ONCE), EAGAIN, "0x81(0/0)");
    clock_gettime(CLOCK_MONOTONIC, &begun);
    REFUSED(rtnet_mailbox_receive(own, NULL, NULL, 0, SECONDS / 50), ETIMEDOUT, "wait longer");
    clock_gettime(CLOCK_MONOTONIC, &ended);
    CHECK((ended.tv_sec - begun.tv_sec) * SECONDS + ended.tv_nsec - begun.tv_nsec >= SECONDS / 50);
}

static void what_is_peeked_at_stays_until_it_is_released(rtnet_mailbox *own, rtnet_sender *to_itself) {
    struct rtnet_head head = {0, 0, 0, 0, 0, 0, 0};
    rtnet_sender *other;
    char part[8] = {0};
    REFUSED(rtnet_mailbox_release(own), ENOMSG, "peek at one first");
    REFUSED(rtnet_mailbox_put_back(own), ENOMSG, "peek at one first");
    REFUSED(rtnet_mailbox_body(own, 0, part, 8), ENOMSG, "peek at one first");
    CHECK(rtnet_sender_send(to_itself, 1, "hello, mailbox", 14) >= 0);
    CHECK(rtnet_sender_send(to_itself, 2, "next", 4) >= 0);
    CHECK(rtnet_mailbox_depth(own) == 2);
    CHECK(rtnet_mailbox_peek(own, &head, RTNET_AT_ONCE) == 14);
    CHECK(head.kind == 1 && head.len == 14 && head.from == OWN);
    CHECK(rtnet_mailbox_body(own, 7, part, 7) == 7 && strcmp(part, "mailbox") == 0);
    CHECK(rtnet_mailbox_body(own, 12, part, 8) == 2);
    CHECK(rtnet_mailbox_body(own, 0xffffffffu, part, 8) == 0);
    REFUSED(rtnet_mailbox_receive(own, &head, part, 8, RTNET_AT_ONCE), EBUSY, "release it, or put it back");
    REFUSED(rtnet_mailbox_peek(own, &head, RTNET_AT_ONCE), EBUSY, "release it");
    REFUSED(rtnet_mailbox_clean(own), EBUSY, "release it");
    REFUSED(rtnet_sender_bind(own, ECHO, &other), EBUSY, "release it");
    CHECK(rtnet_mailbox_put_back(own) == 0);
    /* It is the first still. Too little room leaves it there, and says how much it takes. */
    memset(&head, 0, sizeof head);
    REFUSED(rtnet_mailbox_receive(own, &head, part, 8, RTNET_AT_ONCE), EMSGSIZE, "the package has 14 bytes");
    CHECK(head.len == 14 && head.kind == 1);
    CHECK(rtnet_mailbox_peek(own, NULL, RTNET_AT_ONCE) == 14 && rtnet_mailbox_release(own) == 0);
    CHECK(rtnet_mailbox_receive(own, &head, part, 8, RTNET_AT_ONCE) == 4 && head.kind == 2);
    CHECK(memcmp(part, "next", 4) == 0);
}

static void how_old_a_package_is_can_be_asked_while_it_is_lent(rtnet_component *component, rtnet_mailbox *own,
                                                               rtnet_sender *to_itself) {
    struct rtnet_journey journey;
    struct timespec pause = {0, 2000000};
    REFUSED(rtnet_mailbox_journey(component, own, &journey), ENOMSG, "peek at one first");
    CHECK(rtnet_sender_send(to_itself, 1, NULL, 0) >= 0);
    nanosleep(&pause, NULL);
    CHECK(rtnet_mailbox_peek(own, NULL, RTNET_AT_ONCE) == 0);
    REFUSED(rtnet_mailbox_journey(component, own, NULL), EINVAL, "`journey` points nowhere");
    REFUSED(rtnet_mailbox_journey(NULL, own, &journey), EINVAL, "`component` points nowhere");
    memset(&journey, 0xee, sizeof journey);
    CHECK(rtnet_mailbox_journey(component, own, &journey) == 0);
    /* It was always here; this station shows no time. */
    CHECK(journey.mailbox_ns >= pause.tv_nsec && journey.mailbox_ns < 20 * SECONDS);
    CHECK(journey.age_ns == journey.mailbox_ns && journey.from_elsewhere == 0 && journey.reserved == 0);
    CHECK(journey.sent == 0 && journey.left == 0 && journey.came == 0);
    CHECK(journey.delivered == 0 && journey.received == 0);
    CHECK(journey.slot_wait_ns == RTNET_UNKNOWN_NS && journey.wire_ns == RTNET_UNKNOWN_NS);
    CHECK(journey.router_ns == RTNET_UNKNOWN_NS);
    CHECK(rtnet_mailbox_release(own) == 0);
}

static void what_cannot_be_is_refused_with_why(rtnet_component *component, rtnet_mailbox *own,
                                               rtnet_sender *to_itself) {
    static uint8_t large[RTNET_LARGEST_BODY + 1];
    rtnet_component *nobody = component;
    rtnet_mailbox *mailbox = own;
    rtnet_sender *sender = to_itself;
    struct rtnet_shape shape = SHAPE;
    struct rtnet_router_status status;
    REFUSED(rtnet_component_attach("/nowhere/broker", &nobody), ENOENT, "/nowhere/broker: ");
    CHECK(nobody == NULL);
    CHECK(strstr(rtnet_packages_error(), "look whether the station runs") != NULL);
    REFUSED(rtnet_component_attach(NULL, &nobody), EINVAL, "`path` points nowhere");
    REFUSED(rtnet_component_of_router(NULL, NULL, 0, &nobody), EINVAL, "`router` points nowhere");
    REFUSED(rtnet_component_of_router("a b", NULL, 0, &nobody), EINVAL, "'a b' is no address of a router");
    REFUSED(rtnet_component_of_router("localhost", "/nowhere", 0, &nobody), ENOENT, "/nowhere");
    REFUSED(rtnet_component_of_router("localhost", NULL, RTNET_LARGEST_BODY + 1, &nobody), EMSGSIZE, "largest_body");
    REFUSED(rtnet_component_router_status(component, &status), EOPNOTSUPP, "`rtnet stat`");
    CHECK(nobody == NULL);
    REFUSED(rtnet_mailbox_create(component, OWN, &SHAPE, &mailbox), EEXIST, "0x81(0/0) is there already");
    CHECK(mailbox == NULL);
    REFUSED(rtnet_mailbox_create(component, 0, &SHAPE, &mailbox), EINVAL, "nobody's name");
    REFUSED(rtnet_mailbox_create(component, OWN + 1, NULL, &mailbox), EINVAL, "`shape` points nowhere");
    shape.slots = 0xffffffffu;
    REFUSED(rtnet_mailbox_create(component, OWN + 1, &shape, &mailbox), EINVAL, "1 to 1024");
    shape.slots = 1, shape.replace = 7;
    REFUSED(rtnet_mailbox_create(component, OWN + 1, &shape, &mailbox), EINVAL, "shape->replace");
    REFUSED(rtnet_sender_bind(own, OWN + 9, &sender), ENOENT, "start the component that has it");
    CHECK(sender == NULL);
    REFUSED(rtnet_sender_send(to_itself, 1, NULL, 1), EINVAL, "`body` points nowhere");
    REFUSED(rtnet_sender_send(to_itself, 1, large, 65), EMSGSIZE, "slots take 64");
    REFUSED(rtnet_sender_send(to_itself, 1, large, sizeof large), EMSGSIZE, "262128");
    REFUSED(rtnet_sender_send(to_itself, 1, large, 0xffffffffu), EMSGSIZE, "262128");
    REFUSED(rtnet_mailbox_receive(own, NULL, large, 0xffffffffu, 0), EINVAL, "`room` is 4294967295");
    REFUSED(rtnet_mailbox_receive(own, NULL, NULL, 1, 0), EINVAL, "`body` points nowhere");
    for (int i = 0; i < 4; i++) {
        CHECK(rtnet_sender_send(to_itself, 1, large, 64) >= 0);
    }
    REFUSED(rtnet_sender_send(to_itself, 1, large, 64), ENOBUFS, "all 4 slots of this sender wait");
    CHECK(rtnet_mailbox_clean(own) == 4);
    CHECK(rtnet_mailbox_depth(own) == 0);
}

static void what_is_given_back_can_be_had_again(rtnet_component *component, rtnet_mailbox *own) {
    for (int i = 0; i < 20; i++) {
        rtnet_mailbox *other;
        rtnet_sender *there, *back;
        struct rtnet_head head;
        CHECK(rtnet_mailbox_create(component, OWN + 2, &SHAPE, &other) == 0);
        CHECK(rtnet_sender_bind(own, OWN + 2, &there) == 0);
        CHECK(rtnet_sender_bind(other, OWN, &back) == 0);
        CHECK(rtnet_sender_send(there, 5, &i, sizeof i) >= 0);
        CHECK(rtnet_mailbox_peek(other, &head, 0) == sizeof i && head.kind == 5);
        if (i % 2 == 0) {
            rtnet_sender_unbind(there);
        }
        /* With what is lent of it. */
        rtnet_mailbox_destroy(other);
        if (i % 2 == 1) {
            REFUSED(rtnet_sender_send(there, 5, NULL, 0), ENOENT, "bind to it anew");
            rtnet_sender_unbind(there);
        }
        rtnet_sender_unbind(back);
        CHECK(rtnet_mailbox_depth(own) == 0);
    }
}

int main(int argc, char **argv) {
    rtnet_component *component;
    rtnet_mailbox *own;
    rtnet_sender *echo, *to_itself;
    CHECK(argc == 2);
    CHECK(strcmp(rtnet_packages_error(), "") == 0);
    CHECK(rtnet_component_attach(argv[1], &component) == 0);
    CHECK(rtnet_mailbox_create(component, OWN, &SHAPE, &own) == 0);
    CHECK(rtnet_sender_bind(own, ECHO, &echo) == 0);
    CHECK(rtnet_sender_bind(own, OWN, &to_itself) == 0);
    commands_are_answered(own, echo);
    who_waits_is_told_when_it_is_over(own);
    what_is_peeked_at_stays_until_it_is_released(own, to_itself);
    how_old_a_package_is_can_be_asked_while_it_is_lent(component, own, to_itself);
    what_cannot_be_is_refused_with_why(component, own, to_itself);
    what_is_given_back_can_be_had_again(component, own);
    /* The server ends with this, and the station with it. */
    CHECK(rtnet_sender_send(echo, 22, NULL, 0) >= 0);
    REFUSED(rtnet_mailbox_receive(own, NULL, NULL, 0, 20 * SECONDS), ENODEV, "attach to it again once it runs");
    rtnet_sender_unbind(echo);
    rtnet_sender_unbind(to_itself);
    rtnet_component_detach(component);
    rtnet_mailbox_destroy(own);
    rtnet_component_detach(NULL);
    puts("done");
    return 0;
}
