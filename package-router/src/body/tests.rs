use super::*;
use proptest::prelude::*;

const ORDERS: [Endian; 2] = [Endian::Big, Endian::Little];

record! {
    /// Of many kinds, at places where none of them would be aligned.
    #[derive(Clone, Copy, Debug, PartialEq)]
    struct Mixture {
        one: u8,
        two: i16,
        four: u32,
        eight: f64,
        listener: MailboxName,
        text: [u8; 5],
        points: [Point; 2],
    }
}

record! {
    #[derive(Clone, Copy, Debug, PartialEq)]
    struct Point {
        angle: f32,
        distance: i32,
    }
}

record! {
    /// Without anything that has an order.
    #[derive(Clone, Copy, Debug, PartialEq)]
    pub struct Bytes {
        pub text: [u8; 3],
        pub nothing: (),
    }
}

/// As records are implemented where a macro does not do: one of its fields is not a number.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Active(bool);

impl Record for Active {
    type Wire<O: ByteOrder> = U32<O>;

    fn from_wire<O: ByteOrder>(wire: &U32<O>) -> Self {
        Self(wire.get() != 0)
    }
    fn to_wire<O: ByteOrder>(&self) -> U32<O> {
        U32::new(self.0.into())
    }
}

fn mixture() -> Mixture {
    Mixture {
        one: 0xaa,
        two: -2,
        four: 0x0102_0304,
        eight: 1.0,
        listener: MailboxName(0x0002_0701),
        text: *b"map\0\0",
        points: [Point { angle: 1.0, distance: 1 }, Point { angle: -2.0, distance: -1 }],
    }
}

fn written<R: Record>(record: &R, order: Endian) -> Vec<u8> {
    let mut bytes = vec![0xee; len::<R>() + 3];
    let len = write(record, order, &mut bytes).unwrap();
    assert_eq!(bytes.split_off(len), [0xee; 3], "nothing behind it is touched");
    bytes
}

#[test]
fn a_record_is_packed_and_each_of_its_numbers_has_the_bodys_order() {
    let big = [
        &[0xaa, 0xff, 0xfe, 1, 2, 3, 4][..],
        &[0x3f, 0xf0, 0, 0, 0, 0, 0, 0],
        &[0, 2, 7, 1],
        b"map\0\0",
        &[0x3f, 0x80, 0, 0, 0, 0, 0, 1],
        &[0xc0, 0, 0, 0, 0xff, 0xff, 0xff, 0xff],
    ];
    let little = [
        &[0xaa, 0xfe, 0xff, 4, 3, 2, 1][..],
        &[0, 0, 0, 0, 0, 0, 0xf0, 0x3f],
        &[1, 7, 2, 0],
        b"map\0\0",
        &[0, 0, 0x80, 0x3f, 1, 0, 0, 0],
        &[0, 0, 0, 0xc0, 0xff, 0xff, 0xff, 0xff],
    ];
    for (order, bytes) in [(Endian::Big, big.concat()), (Endian::Little, little.concat())] {
        assert_eq!(written(&mixture(), order), bytes, "{order:?}");
        assert_eq!(read(&bytes, order), Ok(mixture()), "{order:?}");
    }
    assert_eq!(len::<Mixture>(), 40);
}

#[test]
fn what_a_module_asked_for_is_read_as_it_was_seen() {
    // Period 0, data mailbox 0x00020701: the body of getContinuousData, big-endian behind a little-endian head.
    let body = [0, 0, 0, 0, 0, 2, 7, 1];
    assert_eq!(read_prefix::<u32>(&body, Endian::Big), Ok((0, &body[4..])));
    assert_eq!(read(&body[4..], Endian::Big), Ok(MailboxName(0x0002_0701)));
    // Its answer, 100 ms, is little-endian.
    assert_eq!(read(&[0x64, 0, 0, 0], Endian::Little), Ok(100u32));
}

#[test]
fn a_body_may_be_empty() {
    for order in ORDERS {
        assert_eq!((written(&(), order), read(&[], order)), (vec![], Ok(())));
        assert_eq!(read::<()>(&[0], order), Err(BodyError::WrongLen { expected: 0, got: 1 }));
        assert_eq!(write(&(), order, &mut []), Ok(0));
    }
}

#[test]
fn a_record_of_bytes_is_the_same_in_either_order() {
    let bytes = Bytes { text: *b"on\0", nothing: () };
    for order in ORDERS {
        assert_eq!((written(&bytes, order), read(b"on\0", order)), (b"on\0".to_vec(), Ok(bytes)));
    }
}

#[test]
fn a_record_of_other_than_numbers_says_itself_how_it_is_written() {
    for order in ORDERS {
        assert_eq!(read(&[0, 7, 0, 0], order), Ok(Active(true)));
        assert_eq!(read::<Active>(&written(&Active(false), order), order), Ok(Active(false)));
    }
}

#[test]
fn a_body_of_any_other_length_is_refused_and_says_which_it_should_have() {
    let bytes = [0; 60];
    for (got, order) in (0..60).flat_map(|got| ORDERS.map(|order| (got, order))) {
        let (whole, prefix) =
            (read::<Mixture>(&bytes[..got], order), read_prefix::<Mixture>(&bytes[..got], order));
        assert_eq!(whole.err(), (got != 40).then_some(BodyError::WrongLen { expected: 40, got }));
        assert_eq!(prefix.err(), (got < 40).then_some(BodyError::TooShort { least: 40, got }));
    }
    let error = read::<Point>(&bytes[..7], Endian::Big).unwrap_err();
    assert_eq!(error.to_string(), "a body of 7 bytes: this record has exactly 8");
}

#[test]
fn where_there_is_no_room_nothing_is_written() {
    let mut bytes = [0xee; 40];
    for (room, order) in (0..40).flat_map(|room| ORDERS.map(|order| (room, order))) {
        let refused = write(&mixture(), order, &mut bytes[..room]);
        assert_eq!(refused, Err(BodyError::NoRoom { needed: 40, room }));
    }
    assert_eq!(bytes, [0xee; 40]);
    assert_eq!(write(&mixture(), Endian::Big, &mut bytes), Ok(40));
}

#[test]
fn an_array_follows_the_record_that_says_how_long_it_is() {
    let points = [[1.5f32, 2.5], [3.5, 4.5]];
    for order in ORDERS {
        let body = [written(&2i32, order), written(&points[0], order), written(&points[1], order)].concat();
        let (count, mut rest) = read_prefix::<i32>(&body, order).unwrap();
        for point in &points[..count as usize] {
            let (read, behind) = read_prefix::<[f32; 2]>(rest, order).unwrap();
            assert_eq!(&read, point);
            rest = behind;
        }
        assert!(rest.is_empty());
    }
}

proptest! {
    #[test]
    fn numbers_are_read_as_written_in_either_order(
        (a, b, c, d) in any::<(u8, i8, u16, i16)>(),
        (e, f, g, h) in any::<(u32, i32, u64, i64)>(),
        (i, j) in any::<(f32, f64)>(),
    ) {
        for order in ORDERS {
            prop_assert_eq!(read::<u8>(&written(&a, order), order), Ok(a));
            prop_assert_eq!(read::<i8>(&written(&b, order), order), Ok(b));
            prop_assert_eq!(read::<u16>(&written(&c, order), order), Ok(c));
            prop_assert_eq!(read::<i16>(&written(&d, order), order), Ok(d));
            prop_assert_eq!(read::<u32>(&written(&e, order), order), Ok(e));
            prop_assert_eq!(read::<i32>(&written(&f, order), order), Ok(f));
            prop_assert_eq!(read::<u64>(&written(&g, order), order), Ok(g));
            prop_assert_eq!(read::<i64>(&written(&h, order), order), Ok(h));
            prop_assert_eq!(read::<f32>(&written(&i, order), order), Ok(i));
            prop_assert_eq!(read::<f64>(&written(&j, order), order), Ok(j));
        }
    }

    #[test]
    fn what_any_bytes_are_read_as_is_written_back_as_the_same_bytes(bytes in any::<[u8; 28]>()) {
        for order in ORDERS {
            let record: ([u32; 5], [u8; 8]) = (read(&bytes[..20], order).unwrap(), read(&bytes[20..], order).unwrap());
            let again = [written(&record.0, order), written(&record.1, order)].concat();
            prop_assert_eq!(&again[..], &bytes[..]);
        }
    }
}
