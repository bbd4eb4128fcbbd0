"""Several servers on one PostgreSQL: each sees at once what another writes; the database may go away and come back."""

import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import psycopg
import pytest
from support import postgres
from support.stores import EXTRACTOR, Shared, assert_same_view, make_reference, view_of

from mapless_server import errors
from mapless_server.security import DEFAULT_TENANT, SceneKey
from mapless_server.store import Store, StoreError, postgresql

OFFICE = SceneKey("office")
NAME = "vlad"


@pytest.fixture
def both(shared: Shared) -> Iterator[tuple[Store, Store]]:
    with shared.open() as one, shared.open() as other:
        yield one, other


class TestSharing:
    def test_what_one_adds_the_other_has_at_once(self, both: tuple[Store, Store]) -> None:
        one, other = both
        one.create_scene(OFFICE)
        for round_, (writer, reader) in enumerate([(one, other), (other, one)] * 2):
            name = f"r{round_}"
            (record,) = writer.add_references(OFFICE, [make_reference(name, round_, dimension=8)])
            for _ in range(2):  # from the database, then from memory
                snapshot = reader.load_references(OFFICE, [name], EXTRACTOR)
                assert snapshot.generation == writer.get_scene(OFFICE).generation
                assert_same_view(snapshot.references[0].view, view_of(make_reference(name, round_)))
            assert reader.get_scene(OFFICE).reference_count == round_ + 1
            changes = reader.list_changes(OFFICE, snapshot.generation - 1, NAME)
            assert [it.key for it in changes.added] == [record.key]

    def test_the_cache_is_not_used_after_another_servers_change(self, both: tuple[Store, Store]) -> None:
        one, other = both
        one.create_scene(OFFICE)
        one.add_references(OFFICE, [make_reference("a", 1), make_reference("b", 2)])
        for store in both:
            assert len(store.load_references(OFFICE, ["a", "b"], EXTRACTOR).references) == 2
        other.delete_reference(OFFICE, "a")
        with pytest.raises(errors.NotFound, match="'a'"):
            one.load_references(OFFICE, ["a", "b"], EXTRACTOR)
        other.add_references(OFFICE, [make_reference("a", 3)])
        loaded = one.load_references(OFFICE, ["a", "b"], EXTRACTOR)
        assert_same_view(loaded.references[0].view, view_of(make_reference("a", 3)))
        other.delete_scene(OFFICE)
        with pytest.raises(errors.NotFound, match="office"):
            one.load_references(OFFICE, ["a", "b"], EXTRACTOR)
        with pytest.raises(errors.NotFound, match="office"):
            one.list_changes(OFFICE, loaded.generation, NAME)

    @pytest.mark.parametrize("what", ["scene", "reference", "features"])
    def test_one_of_many_changes_wins(self, both: tuple[Store, Store], what: str) -> None:
        if what != "scene":
            both[0].create_scene(OFFICE)
        keys = [it.key for it in both[0].add_references(OFFICE, [make_reference("a")])] if what == "features" else []

        def change(number: int) -> bool:
            store = both[number % 2]
            try:
                if what == "scene":
                    store.create_scene(OFFICE)
                elif what == "reference":
                    store.add_references(OFFICE, [make_reference("mine", number), make_reference(f"n{number}")])
                else:
                    store.add_features(keys[0], "other", view_of(make_reference("a", number)))
            except errors.AlreadyExists:
                return False
            return True

        with ThreadPoolExecutor(8) as pool:
            assert sum(pool.map(change, range(16))) == 1
        scene = both[1].get_scene(OFFICE)
        assert (scene.reference_count, scene.generation) == {"scene": (0, 1), "reference": (2, 2), "features": (1, 2)}[
            what
        ]

    def test_a_scene_deleted_during_additions_is_gone_or_whole(self, both: tuple[Store, Store]) -> None:
        one, other = both
        one.create_scene(OFFICE)

        def add(number: int) -> None:
            try:
                other.add_references(OFFICE, [make_reference(f"{number}", count=1)])
            except errors.NotFound:
                return

        with ThreadPoolExecutor(4) as pool:
            adders = [pool.submit(add, number) for number in range(12)]
            one.delete_scene(OFFICE)
            for adder in adders:
                adder.result(timeout=30)
        assert one.list_scenes(DEFAULT_TENANT, 10) == []
        assert one.create_scene(OFFICE).reference_count == 0


@contextmanager
def own_cluster() -> Iterator[postgres.Cluster]:
    postgres.require()
    cluster = postgres.Cluster()
    try:
        yield cluster
    finally:
        cluster.remove()


class TestGoingAway:
    @pytest.mark.parametrize("how", [signal.SIGQUIT, signal.SIGINT])
    def test_errors_but_no_data_are_lost_and_all_works_again(self, how: signal.Signals) -> None:
        with own_cluster() as cluster, Shared(cluster.fresh_url()).open() as store:
            store.create_scene(OFFICE)
            acknowledged = []
            for life in range(2):
                name = f"r{life}"
                store.add_references(OFFICE, [make_reference("a", 9)] if life == 0 else [make_reference(name, life)])
                acknowledged.append("a" if life == 0 else name)
                with ThreadPoolExecutor(4) as pool:  # so that there are connections to drop
                    list(pool.map(lambda _: store.get_scene(OFFICE), range(8)))
                cluster.stop(how)
                for operation in (
                    lambda: store.get_scene(OFFICE),
                    lambda: store.list_scenes(DEFAULT_TENANT, 10),
                    lambda: store.load_references(OFFICE, ["a"], EXTRACTOR),
                    lambda: store.list_changes(OFFICE, 1, NAME),
                    lambda: store.add_references(OFFICE, [make_reference("lost")]),
                    lambda: store.delete_reference(OFFICE, "a"),
                    lambda: store.create_scene(SceneKey("lost")),
                ):
                    with pytest.raises(errors.Unavailable) as caught:
                        operation()
                    assert caught.value.reason == "STORE_UNAVAILABLE"
                    assert caught.value.retry_after_s == 1
                    assert "\n" not in str(caught.value)
                cluster.start()
                assert [it.reference_id for it in store.list_references(OFFICE, 10)] == acknowledged
                loaded = store.load_references(OFFICE, ["a"], EXTRACTOR).references[0]
                assert_same_view(loaded.view, view_of(make_reference("a", 9)))
                assert store.get_scene(OFFICE).reference_count == len(acknowledged)

    def test_a_connection_that_is_ended_is_one_error_at_most(self, shared: Shared) -> None:
        with shared.open() as store:
            store.create_scene(OFFICE)
            for _ in range(3):
                with postgres.shared_cluster().connect() as connection:
                    connection.execute(
                        "SELECT pg_terminate_backend(pid, 5000) FROM pg_stat_activity "
                        "WHERE application_name = 'mapless-server'"
                    )
                assert store.get_scene(OFFICE).generation == 1  # a dead connection is noticed before it is used

    def test_a_change_cut_off_in_its_middle_leaves_nothing(self, shared: Shared) -> None:
        with shared.open() as store:
            store.create_scene(OFFICE)

            def change() -> None:
                with store.database.write() as connection:
                    connection.exec_driver_sql("UPDATE scene SET reference_count = 5")
                    pid = connection.exec_driver_sql("SELECT pg_backend_pid()").scalar()
                    with postgres.shared_cluster().connect() as other:
                        other.execute("SELECT pg_terminate_backend(%s, 5000)", [pid])
                    connection.exec_driver_sql("UPDATE scene SET reference_count = 6")

            with pytest.raises(errors.Unavailable):
                change()
            assert store.get_scene(OFFICE).reference_count == 0


class TestLimits:
    def test_a_lock_wait_beyond_the_limit_may_be_retried(self, shared: Shared, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(postgresql._SESSION_OPTIONS, "lock_timeout", "50ms")
        with shared.open() as store:
            store.create_scene(OFFICE)
            with psycopg.connect(shared.url) as other:
                other.execute("SELECT * FROM scene_generation FOR UPDATE")
                with pytest.raises(errors.Unavailable, match="busy"):
                    store.add_references(OFFICE, [make_reference("a")])
                assert store.get_scene(OFFICE).generation == 1  # readers do not wait
            store.add_references(OFFICE, [make_reference("a")])

    def test_more_threads_than_connections_wait_or_get_an_error(
        self, shared: Shared, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(postgresql, "CONNECTIONS_AT_MOST", 4)
        monkeypatch.setattr(postgresql, "CONNECTION_WAIT_S", 0.05)
        with shared.open() as store:
            store.create_scene(OFFICE)
            with ThreadPoolExecutor(16) as pool:  # they hold one for less than that
                monkeypatch.setattr(postgresql, "CONNECTION_WAIT_S", 5.0)
                held = [store.database.read() for _ in range(4)]
                for it in held:
                    it.__enter__()
                with pytest.raises(errors.Unavailable, match="busy"):
                    store.get_scene(OFFICE)
                for it in held:
                    it.__exit__(None, None, None)
                assert len({it.generation for it in pool.map(lambda _: store.get_scene(OFFICE), range(4))}) == 1

    def test_commits_are_durable_and_an_operator_may_be_stricter(self, shared: Shared) -> None:
        with shared.open() as store, store.database.write() as connection:
            assert connection.exec_driver_sql("SHOW synchronous_commit").scalar() == "on"
            assert connection.exec_driver_sql("SHOW statement_timeout").scalar() == "1min"
        url = shared.url + "%20-csynchronous_commit%3Dremote_apply&application_name=mine"
        with Store.connect(url) as store, store.database.read() as connection:
            assert connection.exec_driver_sql("SHOW synchronous_commit").scalar() == "remote_apply"
            assert connection.exec_driver_sql("SHOW application_name").scalar() == "mine"


class TestOpening:
    @pytest.mark.parametrize(
        "url",
        [
            "sqlite:///x",
            "mysql://u:secret@h/db",
            "postgresql://u:secret@h",
            "postgresql://u:sec@ret:secret@h:port/db",
            "postgresql://u:p@secret@127.0.0.1:1/db",
            "postgresql://u:p@127.0.0.1/secret@127.0.0.1:1/db",
            "secret",
            "",
            "postgresql://u:secret@127.0.0.1:1/db",
            "postgresql://127.0.0.1:1/db?password=secret&user=u",
            "postgresql://u:secret@no-such-host.invalid/db",
        ],
    )
    def test_a_wrong_url_is_one_sentence_without_the_password(self, url: str) -> None:
        with pytest.raises(StoreError) as caught:
            Store.connect(url)
        assert "secret" not in str(caught.value)
        assert ("%40" in str(caught.value)) == (url.count("@") > 1 and "port" not in url)
        assert "\n" not in str(caught.value)
        assert caught.value.__cause__ is None

    def test_a_database_that_is_not_there_is_named(self) -> None:
        url = postgres.shared_cluster().fresh_url().replace("/postgres?", "/nowhere?")
        with pytest.raises(StoreError, match='database "nowhere" does not exist'):
            Store.connect(url)

    def test_another_encoding_is_refused(self) -> None:
        cluster = postgres.shared_cluster()
        with cluster.connect() as connection:
            connection.execute("CREATE DATABASE latin ENCODING 'SQL_ASCII' TEMPLATE template0")
        with pytest.raises(StoreError, match="SQL_ASCII"):
            Store.connect(cluster.fresh_url().replace("/postgres?", "/latin?"))
