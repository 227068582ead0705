"""A service as its settings say, connected to zenoh, ROS robots and a data directory."""

from service.archive import Archive
from service.clock import SystemClock
from service.map_service import MapService, Ports
from service.ros.gateway import RosGateway
from service.ros.map_out import MapPublisher
from service.settings import Settings
from service.zenoh_source import ZenohSource


def assemble(settings: Settings) -> MapService:
    """Build it; nothing is opened before it is started."""
    clock = SystemClock()
    ingest = settings.ingest
    gateway = RosGateway(
        settings.ros, beams_max=ingest.beams_max, robots_max=ingest.robots_max, clock=clock
    )
    publisher = MapPublisher(settings.ros)
    source = ZenohSource(settings.zenoh, (gateway, publisher))
    archive = (
        None
        if settings.data_dir is None
        else Archive(
            settings.data_dir, settings.journal, settings.map, clock, settings.zenoh.prefix
        )
    )
    ports = Ports(source, archive=archive, clock=clock, acknowledge=source.acknowledge)
    service = MapService(settings, ports)
    publisher.follow(lambda: service.state.snapshot, service.events)
    return service
