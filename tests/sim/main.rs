//! Whole networks in virtual time, one situation per file.

mod backup_masters;
mod calibrated_anew;
mod drift_and_loss;
mod holdover;
mod ideal_host;
mod joint_slots;
mod late_join;
mod lost_on_purpose;
mod master_dies;
mod one_seed_identical_bytes;
mod peer_backup;
mod peer_interop;
mod promised_replies;
mod receive_pool;
mod request_backlog;
mod scenarios;
mod second_master_refuses;
mod virtual_machine;
mod without_a_filter;
mod without_slots;
